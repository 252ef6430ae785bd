"""Bundle adjustment, with covariances

The cameras, the lens and the points that agree best with all pixels at once, found by Levenberg-Marquardt
from a rough start; and what the images leave uncertain.
"""

from dataclasses import replace

import numpy as np

from epipole.mapping import adjust_reconstruction, bundle_problem_of
from epipole.metrics import camera_errors
from epipole.optim import BundleConfig, Loss, adjust_bundle, bundle_covariance, with_fixed_gauge
from epipole.synthetic.problems import bundle_problem

# Twelve images of 400 points, taken on a ring of radius four; each point is seen by five neighbours, half a
# pixel wrong. The start has every pose and point moved at random, a focal length that is off, and no
# distortion. A model of your own is read by `epipole.io.read_colmap_model("OUT/sparse/0")`.

made = bundle_problem(12, 400, 5, noise_px=0.5, seed=4)
truth, start = made.truth, made.start
print(start)
print(
    f"start: {start.mean_reprojection_error_px():.1f} px, truth: {truth.mean_reprojection_error_px():.2f} px"
)

# The arrays of the problem: frames, cameras, points, one row for each observation, and masks that say number
# by number what may change. Focal length and distortion are free, the principal point is not.

problem = bundle_problem_of(start)
print(problem)
print("free:", [n for n, free in zip(start.cameras[0].model.param_names, problem.params_free[0]) if free])

# Images leave place, orientation and scale of the whole open. For covariances these are held: one frame
# entirely, and one coordinate of another.

problem = with_fixed_gauge(problem)
found = adjust_bundle(problem)
print(found)
assert found.final_cost < 1e-2 * found.initial_cost

# What is left over is the noise of the pixels: half the sum of squares is the cost, and two numbers an
# observation, less the unknowns, share it.

covariance = bundle_covariance(problem, found)
print(f"noise from the residuals: {covariance.noise_px:.3f} px")
assert abs(covariance.noise_px - 0.5) < 0.02

# Against the truth: the cameras are compared after the best similarity, the lens as it is.

adjusted, _ = adjust_reconstruction(start)
errors = camera_errors(adjusted.cams_from_world(), truth.cams_from_world())
before = camera_errors(start.cams_from_world(), truth.cams_from_world())
print(f"places off by {before.mean_position:.4f} before, {errors.mean_position:.4f} after")
assert errors.mean_position < 0.2 * before.mean_position

focal_px, focal_sigma = found.camera_params[0, 0], np.sqrt(covariance.camera_params[0, 0, 0])
print(f"focal length {focal_px:.2f} +- {focal_sigma:.2f} px, in truth {truth.cameras[0].focal_px:.0f} px")
assert abs(focal_px - truth.cameras[0].focal_px) < 4 * focal_sigma < 10

# Is that standard deviation honest? Forty other draws of the noise: errors over their stated deviations have
# a root mean square of one if it is.

normalised = []
for seed in range(40):
    one = bundle_problem(12, 400, 5, noise_px=0.5, seed=100 + seed)
    fixed = with_fixed_gauge(bundle_problem_of(one.start))
    result = adjust_bundle(fixed)
    sigma = np.sqrt(bundle_covariance(fixed, result).camera_params[0, 0, 0])
    normalised.append((result.camera_params[0, 0] - one.truth.cameras[0].focal_px) / sigma)
rms = float(np.sqrt(np.mean(np.square(normalised))))
print(f"root mean square of error over sigma, 40 draws: {rms:.2f}")
assert 0.7 < rms < 1.35

# Wrong matches: one keypoint in fifty is moved by up to a hundred pixels. Least squares bends to them, a
# robust loss does not.

rng = np.random.default_rng(0)
keypoints = start.images.keypoints_px.copy()
moved = rng.permutation(len(keypoints))[: len(keypoints) // 50]
keypoints[moved] += rng.uniform(-100, 100, (len(moved), 2))
spoilt = replace(start, images=replace(start.images, keypoints_px=keypoints))
off = {}
for loss in (Loss.TRIVIAL, Loss.CAUCHY):
    model, _ = adjust_reconstruction(spoilt, BundleConfig(loss=loss, loss_scale_px=1.0))
    off[loss] = camera_errors(model.cams_from_world(), truth.cams_from_world()).mean_position
    print(f"with wrong matches, {loss.name.lower()}: places off by {off[loss]:.4f}")
assert off[Loss.CAUCHY] < 1.5 * errors.mean_position < off[Loss.TRIVIAL] / 3
