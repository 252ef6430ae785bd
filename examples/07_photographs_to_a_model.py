"""Photographs to a model

The whole way in one call: a folder of photographs goes in; where each was taken, what the lens was, and a
cloud of points come out. The photographs here are rendered, so that the model can be compared with the truth.
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

# Eight photographs of a courtyard by a lens with a little barrel distortion, with the focal length in their
# EXIF as a phone writes it. With photographs of your own, this block goes, and `photographs =
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

# One call: features, matches, two-view geometries, a model that grows image by image, and bundle
# adjustment.

result = epipole.reconstruct(photographs, out / "model")
model = result.model
print(result)
print("images without a place:", result.reasons or "none")
assert model.is_registered().all()
assert model.mean_reprojection_error_px() < 1.0

# A model from images alone is known up to a similarity: where it is, how it is turned, and its unit of
# length are free. Errors are therefore taken after the similarity that fits the camera centres best, here in
# metres of the true courtyard.

rows = [model.images.name.index(f"{n}.jpg") for n in range(len(true_cams_from_world))]
errors = camera_errors(model.cams_from_world()[rows], true_cams_from_world)
size_m = np.linalg.norm(np.ptp(true_cams_from_world.centers(), axis=0))
print(f"places off by {1000 * errors.mean_position:.2f} mm, of a path of {size_m:.1f} m")
print(f"rotations off by {errors.mean_rotation_deg:.3f} degrees")
assert errors.mean_position < 2e-3 * size_m and errors.mean_rotation_deg < 0.1

# The lens was refined with everything else: EXIF tells the focal length in whole millimetres of a 35 mm
# camera, and nothing of the distortion.

estimated = model.cameras[0]
print(estimated)
assert abs(estimated.focal_px / focal_px - 1.0) < 0.01
assert abs(estimated.params[-1] - -0.05) < 0.02

# The points lie on the surfaces. Those that the first image sees, moved into the world of the truth, have
# the depth that was rendered there (the sky has none: NaN).

points = model.tracks.point_of_observation()[model.tracks.image == rows[0]]
moved = errors.alignment.truth_from_estimated.apply(model.points.xyz_in_world[points])
in_cam = true_cams_from_world[0].apply(moved)
column, row = np.rint(camera.project(in_cam)).astype(int).T
depth = render(courtyard(), camera, true_cams_from_world[0]).depth[row, column]
off_m = np.abs(in_cam[:, 2] - depth)
print(f"{len(points)} points in the first image, depth off by {1000 * np.nanmedian(off_m):.1f} mm (median)")
assert len(points) > 100 and np.nanmedian(off_m) < 0.02

# What stands in the folder: COLMAP's files, points with cameras for any viewer of meshes, a page to look at.
# Other formats are one call away.

assert len(read_colmap_model(out / "model" / "sparse" / "0").points) == len(model.points)
assert (out / "model" / "report.html").is_file()
epipole.convert(out / "model", out / "points.ply", "ply")
assert len(read_points_ply(out / "points.ply").xyz) >= len(model.points)
print("written:", ", ".join(sorted(path.name for path in (out / "model").iterdir())))
