"""Calibrate a camera

Images of a flat board from many sides tell the focal lengths, the principal point and the distortion of a
lens, and how well each is known. The board here is rendered through a lens whose numbers are known.
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

# A chessboard of 9 x 6 inner corners with squares of 25 mm, and a lens with barrel distortion: the truth.

true_camera = epipole.Camera("OPENCV", 480, 360, [390.0, 393.0, 236.0, 177.0, -0.25, 0.08, 0.001, -0.0005])
board = SyntheticScene.of(chessboard_sheet(9, 6, 0.025, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))

# Ten images from about 40 cm, tilted to all sides and all over the image: views that are parallel to the
# board do not tell the focal length, and corners near the middle alone do not tell the distortion. With
# images of your own, this block goes, and `photographs = Path("BOARDS")`.

photographs = out / "boards"
photographs.mkdir(parents=True, exist_ok=True)
rng = np.random.default_rng(5)
for n in range(10):
    rotation = Rotation3.exp(rng.uniform([-0.6, -0.6, -0.3], [0.6, 0.6, 0.3])).matrix
    at = np.array([rng.uniform(-0.10, 0.10), rng.uniform(-0.07, 0.07), rng.uniform(0.30, 0.45)])
    image = render(board, true_camera, Rigid3(rotation, at), noise_sigma=2.0, seed=n)
    Image.fromarray(image.rgb).save(photographs / f"{n:02d}.jpg", quality=95)

# Corners are found, and lens and views adjusted together, the board being known. All that is told is the size
# of the board: `columns` and `rows` count inner corners, and `square` is in metres.

run = epipole.calibrate(photographs, out / "calibration", columns=9, rows=6, square=0.025)
found = run.calibration
print(found)
print(run.verdict.sentence)
assert [state.value for state in found.view_states[0]].count("used") >= 8

# Each number comes with its standard deviation. Errors are within a few of them.

camera, sigma = found.cameras[0], found.params_sigma(0)
for name, value, deviation, true in zip(camera.model.param_names, camera.params, sigma, true_camera.params):
    print(f"{name:3s} {value:9.4f} +- {deviation:.4f}, in truth {true:g}")
off = np.abs(camera.params - true_camera.params) / sigma
assert off.max() < 5.0
assert abs(camera.focal_px / true_camera.focal_px - 1.0) < 5e-3

# Numbers of a lens trade against each other and against the poses, so two lenses are better compared by their
# rays: how far apart are the pixels of the same directions over the whole image, after the turn of the
# camera that makes them most alike?

x, y = np.meshgrid(np.linspace(10, 469, 20), np.linspace(10, 349, 15))
pixels = np.stack([x.ravel(), y.ravel()], axis=1)
true_rays = true_camera.unproject(pixels)
rotation = Rotation3.nearest(camera.unproject(pixels).T @ true_rays)
apart_px = np.linalg.norm(camera.project(rotation.apply(true_rays)) - pixels, axis=1)
print(f"the same rays are {np.median(apart_px):.2f} px apart (median), {apart_px.max():.2f} px at most")
assert np.median(apart_px) < 0.3 and apart_px.max() < 1.5

# The residuals are the corners' own noise.

print(f"root mean square of the residuals: {found.rms_px:.3f} px")
assert found.rms_px < 0.3

# The calibration is a file that `reconstruct`, `slam` and `stereo` take, on the command line as
# `--calibration FILE`.

again = read_calibration(out / "calibration" / "calibration.json").cameras[0]
assert np.allclose(again.params, camera.params)
