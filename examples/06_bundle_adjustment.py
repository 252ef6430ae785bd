"""Bundle adjustment with covariances

Bundle adjustment optimizes poses, camera parameters and points jointly, to minimize the reprojection errors.
This page runs it from a rough initialization, compares the result with the truth and checks the covariances.
"""

from dataclasses import replace

import numpy as np

from epipole.mapping import adjust_reconstruction, bundle_problem_of
from epipole.metrics import camera_errors
from epipole.optim import BundleConfig, Loss, adjust_bundle, bundle_covariance, with_fixed_gauge
from epipole.synthetic.problems import bundle_problem

# Generate 12 images of 400 points, taken on a ring of radius four. Five neighboring images observe each
# point, with half a pixel of noise. The initialization has perturbed poses and points, a wrong focal length
# and no distortion. To read your own model, use `epipole.io.read_colmap_model("OUT/sparse/0")`.

generated = bundle_problem(12, 400, 5, noise_px=0.5, seed=4)
truth, start = generated.truth, generated.start
print(start)
print(
    f"start: {start.mean_reprojection_error_px():.1f} px, truth: {truth.mean_reprojection_error_px():.2f} px"
)

# A `BundleProblem` stores frames, cameras, points and one row per observation. Masks specify which parameters
# are free. Here the focal length and the distortion are free, and the principal point is fixed.

problem = bundle_problem_of(start)
print(problem)
print("free:", [n for n, free in zip(start.cameras[0].model.param_names, problem.params_free[0]) if free])

# Images do not determine the position, orientation and scale of the model, and the covariances need this
# gauge to be fixed. `with_fixed_gauge` fixes one frame and one coordinate of a second frame.

problem = with_fixed_gauge(problem)
found = adjust_bundle(problem)
print(found)
assert found.final_cost < 1e-2 * found.initial_cost

# The residuals determine the pixel noise. With N observations and U unknowns, its variance is 2 cost / (2 N -
# U), because the cost is half the sum of squares and each observation has two residuals.

covariance = bundle_covariance(problem, found)
print(f"noise from the residuals: {covariance.noise_px:.3f} px")
assert abs(covariance.noise_px - 0.5) < 0.02

# Compare the result with the truth. `camera_errors` aligns the poses with a similarity first. The focal
# length needs no alignment.

adjusted, _ = adjust_reconstruction(start)
errors = camera_errors(adjusted.cams_from_world(), truth.cams_from_world())
errors_before = camera_errors(start.cams_from_world(), truth.cams_from_world())
print(f"mean position error {errors_before.mean_position:.4f} before, {errors.mean_position:.4f} after")
assert errors.mean_position < 0.2 * errors_before.mean_position

focal_px, focal_sigma = found.camera_params[0, 0], np.sqrt(covariance.camera_params[0, 0, 0])
print(f"focal length {focal_px:.2f} +- {focal_sigma:.2f} px, true value {truth.cameras[0].focal_px:.0f} px")
assert abs(focal_px - truth.cameras[0].focal_px) < 4 * focal_sigma < 10

# Check the standard deviation of the focal length with 40 other samples of the noise. If it is correct, the
# RMS of error over standard deviation is close to one.

normalized = []
for seed in range(40):
    sample = bundle_problem(12, 400, 5, noise_px=0.5, seed=100 + seed)
    fixed = with_fixed_gauge(bundle_problem_of(sample.start))
    result = adjust_bundle(fixed)
    sigma = np.sqrt(bundle_covariance(fixed, result).camera_params[0, 0, 0])
    normalized.append((result.camera_params[0, 0] - sample.truth.cameras[0].focal_px) / sigma)
rms = float(np.sqrt(np.mean(np.square(normalized))))
print(f"RMS of error over sigma, 40 samples: {rms:.2f}")
assert 0.7 < rms < 1.35

# Add outliers: move one keypoint in fifty by up to 100 pixels per axis. The outliers distort a least-squares
# fit, but not a fit with a robust loss.

rng = np.random.default_rng(0)
keypoints = start.images.keypoints_px.copy()
moved = rng.permutation(len(keypoints))[: len(keypoints) // 50]
keypoints[moved] += rng.uniform(-100, 100, (len(moved), 2))
with_outliers = replace(start, images=replace(start.images, keypoints_px=keypoints))
error = {}
for loss in (Loss.TRIVIAL, Loss.CAUCHY):
    model, _ = adjust_reconstruction(with_outliers, BundleConfig(loss=loss, loss_scale_px=1.0))
    error[loss] = camera_errors(model.cams_from_world(), truth.cams_from_world()).mean_position
    print(f"with outliers, {loss.name.lower()}: mean position error {error[loss]:.4f}")
assert error[Loss.CAUCHY] < 1.5 * errors.mean_position < error[Loss.TRIVIAL] / 3
