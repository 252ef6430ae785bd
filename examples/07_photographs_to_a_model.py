"""Reconstruct a model from photographs

`epipole.reconstruct` takes a folder of photographs and estimates camera poses, intrinsics and a point cloud.
The photographs on this page are rendered, so the model can be compared with the truth.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import epipole
from epipole.io import read_colmap_model, read_points_ply
from epipole.io.images.photographs import write_jpeg_with_exif
from epipole.metrics import camera_errors
from epipole.synthetic import courtyard, courtyard_views, render

out = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())

# Render eight photographs of a courtyard with slight barrel distortion. Their EXIF data contain the focal
# length, as with photographs of a phone. To use your own photographs, replace this block with `photographs =
# Path("IMAGES")`.

width, height, focal_35mm = 480, 320, 28.0
focal_px = focal_35mm / 36.0 * width
camera = epipole.Camera("SIMPLE_RADIAL", width, height, [focal_px, (width - 1) / 2, (height - 1) / 2, -0.05])
true_cams_from_world = courtyard_views(24)[np.arange(4, 20, 2)]
photographs = out / "photographs"
photographs.mkdir(parents=True, exist_ok=True)
for n, cam_from_world in enumerate(true_cams_from_world):
    image = render(courtyard(), camera, cam_from_world, noise_sigma=2.0, seed=n)
    write_jpeg_with_exif(photographs / f"{n}.jpg", image.rgb, focal_35mm=focal_35mm)

# One call runs feature extraction, matching, two-view geometry, incremental reconstruction and bundle
# adjustment.

result = epipole.reconstruct(photographs, out / "model")
model = result.model
print(result)
print("unregistered images:", result.reasons or "none")
assert model.is_registered().all()
assert model.mean_reprojection_error_px() < 1.0

# Images alone determine a model up to a similarity: its position, orientation and unit of length are
# arbitrary. `camera_errors` fits a similarity to the camera centers first, so the errors are in meters of the
# true courtyard.

rows = [model.images.name.index(f"{n}.jpg") for n in range(len(true_cams_from_world))]
errors = camera_errors(model.cams_from_world()[rows], true_cams_from_world)
size_m = np.linalg.norm(np.ptp(true_cams_from_world.centers(), axis=0))
print(f"mean position error {1000 * errors.mean_position:.2f} mm, scene size {size_m:.1f} m")
print(f"mean rotation error {errors.mean_rotation_deg:.3f} degrees")
assert errors.mean_position < 2e-3 * size_m and errors.mean_rotation_deg < 0.1

# Bundle adjustment also refined the intrinsics. EXIF contains the focal length in whole millimeters of a 35
# mm camera, but no distortion.

estimated = model.cameras[0]
print(estimated)
assert abs(estimated.focal_px / focal_px - 1.0) < 0.01
assert abs(estimated.params[-1] - -0.05) < 0.02

# The points lie on the surfaces of the scene. Transform the points of the first image to the true world, and
# compare their depths with the rendered depth map. The depth of the sky is NaN.

points = model.tracks.point_of_observation()[model.tracks.image == rows[0]]
points_in_world = errors.alignment.truth_from_estimated.apply(model.points.xyz_in_world[points])
in_cam = true_cams_from_world[0].apply(points_in_world)
column, row = np.rint(camera.project(in_cam)).astype(int).T
depth = render(courtyard(), camera, true_cams_from_world[0]).depth[row, column]
error_m = np.abs(in_cam[:, 2] - depth)
print(f"{len(points)} points in the first image, median depth error {1000 * np.nanmedian(error_m):.1f} mm")
assert len(points) > 100 and np.nanmedian(error_m) < 0.02

# The output folder contains a COLMAP model, a PLY file with points and cameras, and an HTML report.
# `epipole.convert` writes other formats.

assert len(read_colmap_model(out / "model" / "sparse" / "0").points) == len(model.points)
assert (out / "model" / "report.html").is_file()
epipole.convert(out / "model", out / "points.ply", "ply")
assert len(read_points_ply(out / "points.ply").xyz) >= len(model.points)
print("written:", ", ".join(sorted(path.name for path in (out / "model").iterdir())))
