"""Stereo disparity and depth

In a rectified pair, a point has the same row in both images. Its disparity d is the difference between its
columns, and its depth is Z = f B / d. An error in disparity causes a depth error that grows with the square
of the depth.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import epipole
from epipole.disparity_search.search import match_stereo
from epipole.image.color_map import color_map
from epipole.pipelines.stereo.depth import depth_of
from epipole.scene import StereoReason
from epipole.synthetic.stereo_rooms import stereo_street

out = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
out.mkdir(parents=True, exist_ok=True)

# Render a street with objects at 2 to 30 meters, seen by two cameras 12 cm apart, with the true disparity of
# every pixel. With your own images, `left` and `right` are arrays (h, w), and the focal length and the
# baseline come from the calibration.

pair = stereo_street(3, size=(480, 360), focal_px=600.0, baseline=0.12)
left, right, camera = pair.left, pair.right, pair.camera
cx, cy = camera.params[2:]
rig = epipole.RectifiedRig(focal_px=camera.focal_px, cx=cx, cy=cy, baseline=pair.baseline)

# `match_stereo` compares census windows, sums the costs along eight paths (Hirschmueller 2008) and verifies
# each match in the right image. Pixels without a reliable match are NaN, with a reason.

found = match_stereo(left, right, epipole.StereoConfig(max_disparity_px=63))
print(found)
for reason in StereoReason:
    print(f"{reason.name:12s} {100 * (found.reason == reason).mean():5.1f} %")
assert found.density > 0.6
assert np.isnan(found.disparity_px[found.reason != StereoReason.OK]).all()

# Compare with the true disparities.

known = np.isfinite(found.disparity_px) & np.isfinite(pair.disparity_px)
error_px = found.disparity_px[known] - pair.disparity_px[known]
print(f"median error {np.median(np.abs(error_px)):.2f} px")
print(f"errors above 1 px: {100 * (np.abs(error_px) > 1).mean():.1f} %")
assert np.median(np.abs(error_px)) < 0.5 and (np.abs(error_px) > 1).mean() < 0.1

# Each disparity has a standard deviation, calibrated so that 68 % of the errors are smaller. Check the
# percentage on this pair.

fraction = (np.abs(error_px) < found.sigma_px[known]).mean()
print(f"within one standard deviation: {100 * fraction:.0f} %")
assert 0.5 < fraction < 0.9

# `depth_of` computes the depth in the unit of the baseline. Its standard deviation is Z^2 / (f B) times that
# of the disparity.

depths = depth_of(found, rig)
true_depth = rig.focal_px * rig.baseline / pair.disparity_px
expected_sigma = depths.depth[known] ** 2 / (rig.focal_px * rig.baseline) * found.sigma_px[known]
assert np.allclose(depths.sigma[known], expected_sigma, rtol=1e-4)

# The standard deviation grows with the square of the depth. For the same disparity error, a point ten times
# as far has a depth error a hundred times as large.

for near, far in ((2, 4), (4, 8), (8, 16), (16, 32)):
    in_range = known & (true_depth >= near) & (true_depth < far)
    error = np.median(np.abs(depths.depth[in_range] - true_depth[in_range]))
    sigma = np.median(depths.sigma[in_range])
    print(f"{near:2d} to {far:2d} m: median error {error:.3f} m, standard deviation {sigma:.3f} m")
    assert error < 2 * sigma
close, distant = (np.median(depths.sigma[known & (np.abs(true_depth - z) < 0.25 * z)]) for z in (3.0, 24.0))
assert distant > 20 * close

# Write the disparities as an image, where near points are red. `epipole.stereo("left.png", "right.png",
# "OUT", rig=rig)` writes all of these results, a point cloud and a report. `epipole stereo doctor` finds the
# problems of a pair.

Image.fromarray(color_map(found.disparity_px)).save(out / "disparity.png")
Image.fromarray(left).save(out / "left.png")
