"""Stereo: disparity, depth, and its error bar

In a rectified pair a point lies on the same row of both images, so many pixels further left in the right
one: its disparity. Depth is Z = f B / d, and an error of the disparity becomes an error of depth that grows
with the square of the range.
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

# A rendered street with objects from 2 to 30 metres, seen by two cameras 12 cm apart, with the truth for
# every pixel. With images of your own, `left` and `right` are arrays (h, w), and focal length and baseline
# come from the calibration.

pair = stereo_street(3, size=(480, 360), focal_px=600.0, baseline=0.12)
left, right, camera = pair.left, pair.right, pair.camera
cx, cy = camera.params[2:]
rig = epipole.RectifiedRig(focal_px=camera.focal_px, cx=cx, cy=cy, baseline=pair.baseline)

# Census windows are compared, their costs summed along eight paths (Hirschmueller 2008), and the right
# image is asked, too: what it does not confirm stays unknown. Unknown pixels are NaN and have a reason.

found = match_stereo(left, right, epipole.StereoConfig(max_disparity_px=63))
print(found)
for reason in StereoReason:
    print(f"{reason.name:12s} {100 * (found.reason == reason).mean():5.1f} %")
assert found.density > 0.6
assert np.isnan(found.disparity_px[found.reason != StereoReason.OK]).all()

# Against the truth.

known = np.isfinite(found.disparity_px) & np.isfinite(pair.disparity_px)
off_px = found.disparity_px[known] - pair.disparity_px[known]
print(f"median error {np.median(np.abs(off_px)):.2f} px")
print(f"off by more than 1 px: {100 * (np.abs(off_px) > 1).mean():.1f} %")
assert np.median(np.abs(off_px)) < 0.5 and (np.abs(off_px) > 1).mean() < 0.1

# Each disparity has a standard deviation of its own, fitted so that 68 of 100 errors are smaller. On this
# pair:

within = (np.abs(off_px) < found.sigma_px[known]).mean()
print(f"within one standard deviation: {100 * within:.0f} of 100")
assert 0.5 < within < 0.9

# Depth, in the unit of the baseline, and its error: Z^2 / (f B) times that of the disparity.

depths = depth_of(found, rig)
true_depth = rig.focal_px * rig.baseline / pair.disparity_px
by_hand = depths.depth[known] ** 2 / (rig.focal_px * rig.baseline) * found.sigma_px[known]
assert np.allclose(depths.sigma[known], by_hand, rtol=1e-4)

# The error bar grows with the square of the range: with the same error of the disparity, ten times as far is
# a hundred times as unsure.

for near, far in ((2, 4), (4, 8), (8, 16), (16, 32)):
    here = known & (true_depth >= near) & (true_depth < far)
    error, stated = np.median(np.abs(depths.depth[here] - true_depth[here])), np.median(depths.sigma[here])
    print(f"{near:2d} to {far:2d} m: off by {error:.3f} m (median), stated {stated:.3f} m")
    assert error < 2 * stated
close, distant = (np.median(depths.sigma[known & (np.abs(true_depth - z) < 0.25 * z)]) for z in (3.0, 24.0))
assert distant > 20 * close

# Look at it: near is red. `epipole.stereo("left.png", "right.png", "OUT", rig=rig)` writes all of this, a
# cloud of points and a page, and `epipole stereo doctor` says what is wrong with a pair.

Image.fromarray(color_map(found.disparity_px)).save(out / "disparity.png")
Image.fromarray(left).save(out / "left.png")
