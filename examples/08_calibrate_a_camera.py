"""Calibrate a camera

Images of a flat board from different directions determine the focal lengths, the principal point and the
distortion of a camera, with standard deviations. The images on this page are rendered with known parameters.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import epipole
from epipole.geometry import Rigid3, Rotation3
from epipole.io.calibration.files import read_calibration
from epipole.synthetic import SyntheticScene, render
from epipole.synthetic.markers import chessboard_sheet

out = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())

# The true camera has barrel distortion. The chessboard has 9 x 6 inner corners and squares of 25 mm.

true_camera = epipole.Camera("OPENCV", 480, 360, [390.0, 393.0, 236.0, 177.0, -0.25, 0.08, 0.001, -0.0005])
board = SyntheticScene.of(chessboard_sheet(9, 6, 0.025, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))

# Render ten images from about 40 cm. Tilt the board in all directions and cover the full image: views
# parallel to the board do not determine the focal length, and corners near the image center do not determine
# the distortion. To use your own images, replace this block with `photographs = Path("BOARDS")`.

photographs = out / "boards"
photographs.mkdir(parents=True, exist_ok=True)
rng = np.random.default_rng(5)
for n in range(10):
    rotation = Rotation3.exp(rng.uniform([-0.6, -0.6, -0.3], [0.6, 0.6, 0.3])).matrix
    translation = np.array([rng.uniform(-0.10, 0.10), rng.uniform(-0.07, 0.07), rng.uniform(0.30, 0.45)])
    image = render(board, true_camera, Rigid3(rotation, translation), noise_sigma=2.0, seed=n)
    Image.fromarray(image.rgb).save(photographs / f"{n:02d}.jpg", quality=95)

# `calibrate` detects the corners, then optimizes the camera parameters and the board poses jointly. `columns`
# and `rows` count inner corners, and `square` is the side length of a square in meters.

run = epipole.calibrate(photographs, out / "calibration", columns=9, rows=6, square=0.025)
found = run.calibration
print(found)
print(run.verdict.sentence)
assert [state.value for state in found.view_states[0]].count("used") >= 8

# Each parameter has a standard deviation, and its error is at most a few standard deviations.

camera, sigma = found.cameras[0], found.params_sigma(0)
for name, value, deviation, true_value in zip(
    camera.model.param_names, camera.params, sigma, true_camera.params
):
    print(f"{name:3s} {value:9.4f} +- {deviation:.4f}, true value {true_value:g}")
normalized_errors = np.abs(camera.params - true_camera.params) / sigma
assert normalized_errors.max() < 5.0
assert abs(camera.focal_px / true_camera.focal_px - 1.0) < 5e-3

# The parameters correlate with each other and with the poses, so compare cameras by their rays instead.
# Project the rays of the true camera with the estimated camera, after the rotation that aligns the rays best,
# and measure the pixel differences over the image.

x, y = np.meshgrid(np.linspace(10, 469, 20), np.linspace(10, 349, 15))
pixels = np.stack([x.ravel(), y.ravel()], axis=1)
true_rays = true_camera.unproject(pixels)
rotation = Rotation3.nearest(camera.unproject(pixels).T @ true_rays)
difference_px = np.linalg.norm(camera.project(rotation.apply(true_rays)) - pixels, axis=1)
print(f"pixel difference: median {np.median(difference_px):.2f} px, maximum {difference_px.max():.2f} px")
assert np.median(difference_px) < 0.3 and difference_px.max() < 1.5

# The remaining residuals are noise of the detected corners.

print(f"RMS of the residuals: {found.rms_px:.3f} px")
assert found.rms_px < 0.3

# `reconstruct`, `slam` and `stereo` accept the calibration file. On the command line, pass `--calibration
# FILE`.

loaded = read_calibration(out / "calibration" / "calibration.json").cameras[0]
assert np.allclose(loaded.params, camera.params)
