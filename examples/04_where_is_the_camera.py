"""Absolute pose of a camera (PnP)

Given 3D points and their pixels, `estimate_absolute_pose` computes the pose of the camera.
Structure-from-motion uses it to register images, SLAM to relocalize, and robots to locate markers. In this
example, 30 % of the pixels are outliers.
"""

import numpy as np

from epipole.geometry import Rotation3
from epipole.robust import Reason, estimate_absolute_pose, estimate_pose_and_focal, estimate_upright_pose
from epipole.synthetic.problems import absolute_pose_problem

# Generate a problem with a known solution: 200 points, half a pixel of noise and 60 outliers. With your own
# data, `points_in_world` is (n, 3), `pixels` is (n, 2), and `camera` comes from a calibration.

problem = absolute_pose_problem(200, outlier_ratio=0.3, noise_px=0.5, seed=1)
points_in_world, pixels, camera = problem.points_in_world, problem.pixels, problem.camera

# Three points determine up to four poses. RANSAC tries many samples of three points, and refines the best
# pose on all its inliers.

found = estimate_absolute_pose(points_in_world, pixels, camera)
print(found, f"noise {found.noise_px:.2f} px after {found.num_iterations} samples")
assert found.success and abs(found.noise_px - 0.5) < 0.1
assert (found.inlier_mask == problem.inlier_mask).mean() > 0.97

# The model is `cam_from_world`. Compare the camera position and the rotation with the true pose.

truth = problem.cam_from_world
position_error = np.linalg.norm(found.model.centers() - truth.centers())
rotation_deg = np.degrees((Rotation3(found.model.rotation) @ Rotation3(truth.rotation).inverse()).angle_rad())
print(f"position error {1000 * position_error:.1f} mm at 4 to 9 m, rotation error {rotation_deg:.3f} degrees")
assert position_error < 0.02 and rotation_deg < 0.1

# The remaining residuals are noise: every inlier reprojects to within a few standard deviations of its pixel.

projected = camera.project(found.model.apply(points_in_world))
error_px = np.linalg.norm(projected - pixels, axis=1)
assert np.allclose(error_px[found.inlier_mask], found.residuals_px[found.inlier_mask], atol=1e-2)
assert error_px[problem.inlier_mask].max() < 3.0 < np.median(error_px[~problem.inlier_mask])

# The covariance describes the uncertainty of the pose. It refers to xi in exp(xi) @ cam_from_world. The
# squared Mahalanobis distance of the true pose follows a chi-square distribution with six degrees of freedom,
# and is below 22.5 with a probability of 99.9 %.

xi = (truth @ found.model.inverse()).log()
squared_distance = xi @ np.linalg.solve(found.covariance, xi)
print(f"squared Mahalanobis distance: {squared_distance:.1f} (6 is expected)")
assert 0.3 < squared_distance < 22.5

# If the focal length is unknown, a sample needs four points instead of three.

with_focal = estimate_pose_and_focal(points_in_world, pixels, camera.K[:2, 2])
focal_px = with_focal.model.focal_px
print(f"focal length {focal_px:.1f} px, true value {camera.focal_px:.0f} px")
assert abs(focal_px / camera.focal_px - 1.0) < 0.01

# If the direction of gravity is known, for example from an accelerometer at rest, two points determine the
# pose. Small samples pay off with many outliers, 85 % here: the fewer points a sample has, the more likely it
# has no outlier.

hard = absolute_pose_problem(400, outlier_ratio=0.85, noise_px=0.5, seed=1)
down_in_cam = hard.cam_from_world.rotation @ np.array([0.0, 0.0, -1.0])
upright = estimate_upright_pose(hard.points_in_world, hard.pixels, hard.camera, down_in_cam)
free = estimate_absolute_pose(hard.points_in_world, hard.pixels, hard.camera)
print(f"samples: {upright.num_iterations} with gravity, {free.num_iterations} without")
assert upright.num_iterations < free.num_iterations
for estimate in (upright, free):
    assert np.linalg.norm(estimate.model.centers() - hard.cam_from_world.centers()) < 0.05

# If the points do not determine the pose, the estimate fails with a reason. Here all points are on one line,
# so the rotation about the line is unknown.

line = np.array([0.0, 0.0, 5.0]) + np.linspace(-1.0, 1.0, 50)[:, None] * np.array([1.0, 0.2, 0.1])
on_line = truth.inverse().apply(line)
degenerate = estimate_absolute_pose(on_line, camera.project(line), camera)
print("points on a line:", degenerate.reason.value)
assert not degenerate.success and degenerate.reason is not Reason.OK
