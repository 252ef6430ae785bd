"""Where is the camera? (PnP)

Known points and their pixels tell where a camera stands. It is how photographs are added to a model, how a
robot finds itself in a map, and how a marker is located. Thirty in a hundred of the pixels here belong to
other points.
"""

import numpy as np

from epipole.geometry import Rotation3
from epipole.robust import Reason, estimate_absolute_pose, estimate_pose_and_focal, estimate_upright_pose
from epipole.synthetic.problems import absolute_pose_problem

# A made-up problem with a known answer: 200 points, half a pixel of noise, 60 wrong pixels. With data of your
# own, `points_in_world` is (n, 3), `pixels` is (n, 2), and `camera` comes from a calibration.

problem = absolute_pose_problem(200, outlier_ratio=0.3, noise_px=0.5, seed=1)
points_in_world, pixels, camera = problem.points_in_world, problem.pixels, problem.camera

# Three points give up to four poses; many samples of three are tried, and the best one is refined on all that
# agree.

found = estimate_absolute_pose(points_in_world, pixels, camera)
print(found, f"noise {found.noise_px:.2f} px after {found.num_iterations} samples")
assert found.success and abs(found.noise_px - 0.5) < 0.1
assert (found.inlier_mask == problem.inlier_mask).mean() > 0.97

# The model is `cam_from_world`; where the camera is are its centre and its rotation.

true = problem.cam_from_world
off_by = np.linalg.norm(found.model.centers() - true.centers())
turned_deg = np.degrees((Rotation3(found.model.rotation) @ Rotation3(true.rotation).inverse()).angle_rad())
print(f"place off by {1000 * off_by:.1f} mm at a distance of 4 to 9 m, turned by {turned_deg:.3f} degrees")
assert off_by < 0.02 and turned_deg < 0.1

# What remains is noise: the points that agree fall on their pixels to within a few times half a pixel.

projected = camera.project(found.model.apply(points_in_world))
error_px = np.linalg.norm(projected - pixels, axis=1)
assert np.allclose(error_px[found.inlier_mask], found.residuals_px[found.inlier_mask], atol=1e-2)
assert error_px[problem.inlier_mask].max() < 3.0 < np.median(error_px[~problem.inlier_mask])

# How sure is it? The covariance is that of xi in exp(xi) @ cam_from_world. The squared error measured by it
# is a chi-square of six degrees of freedom, of which 99.9 in 100 are below 22.5.

xi = (true @ found.model.inverse()).log()
distance = xi @ np.linalg.solve(found.covariance, xi)
print(f"squared error over its covariance: {distance:.1f} (6 is usual)")
assert 0.3 < distance < 22.5

# With an unknown focal length one more point is needed, four in place of three.

with_focal = estimate_pose_and_focal(points_in_world, pixels, camera.K[:2, 2])
focal_px = with_focal.model.focal_px
print(f"focal length {focal_px:.1f} px, in truth {camera.focal_px:.0f} px")
assert abs(focal_px / camera.focal_px - 1.0) < 0.01

# With gravity known (an accelerometer at rest), two points fix a pose in place of three. That matters where
# most pixels are wrong, here 85 of 100: the fewer points a sample has, the sooner one without a wrong point
# is drawn.

hard = absolute_pose_problem(400, outlier_ratio=0.85, noise_px=0.5, seed=1)
down_in_cam = hard.cam_from_world.rotation @ np.array([0.0, 0.0, -1.0])
upright = estimate_upright_pose(hard.points_in_world, hard.pixels, hard.camera, down_in_cam)
free = estimate_absolute_pose(hard.points_in_world, hard.pixels, hard.camera)
print(f"samples: {upright.num_iterations} with gravity, {free.num_iterations} without")
assert upright.num_iterations < free.num_iterations
for one in (upright, free):
    assert np.linalg.norm(one.model.centers() - hard.cam_from_world.centers()) < 0.05

# What cannot be known is said, not guessed: points on one line leave the turn about it open.

line = np.array([0.0, 0.0, 5.0]) + np.linspace(-1.0, 1.0, 50)[:, None] * np.array([1.0, 0.2, 0.1])
on_line = true.inverse().apply(line)
lost = estimate_absolute_pose(on_line, camera.project(line), camera)
print("points on a line:", lost.reason.value)
assert not lost.success and lost.reason is not Reason.OK
