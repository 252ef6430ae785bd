"""Metric scale

The images of a single camera determine a model up to scale. Measured camera positions, a known length, a
marker of known size or odometry determine the scale in meters. Each source gives an estimate with a standard
deviation, and `agreed_scale` combines the estimates if they agree.
"""

import numpy as np

from epipole.errors import DegenerateGeometryError
from epipole.geometry import Similarity3
from epipole.scale import ScaleEstimate, agreed_scale, fit_scale_to_object, fit_scale_to_positions
from epipole.synthetic.problems import bundle_problem

# Generate a metric model of 16 images. Transform it to an arbitrary world and unit, as a reconstruction would
# return it. One unit is 2.5 meters. The task is to estimate this number.

rng = np.random.default_rng(3)
truth = bundle_problem(16, 300, 5, noise_px=0.5, seed=2).truth
rotation = Similarity3.exp([1.0, -2.0, 0.5, 0.3, -0.8, 0.4, 0.0])
model = truth.transformed(Similarity3(1 / 2.5, rotation.rotation, rotation.translation))
print(model)

# For your own images, use `model = epipole.reconstruct("IMAGES", "OUT").model`. With the arguments
# `positions="positions.txt", lengths="lengths.txt", tag_size_m=0.12`, `reconstruct` estimates the scale from
# these references.

# Measured positions: GPS or a total station measures the camera positions with a standard deviation of 3 cm
# per coordinate. `fit_scale_to_positions` fits a similarity (Umeyama 1991) and computes the standard
# deviation of its scale.

measured = truth.camera_centers_in_world() + 0.03 * rng.standard_normal((16, 3))
by_positions = fit_scale_to_positions(model.camera_centers_in_world(), measured, sigma=0.03)
print("positions:", by_positions)
scale_of_positions = float(by_positions.world_from_model.scale)
assert abs(scale_of_positions - 2.5) < 4 * by_positions.sigma < 0.1

# Known length: both ends of a 1.2 m bar are marked in five images, with one pixel of noise. `clicks` contains
# the pixels for each image. Use NaN for an end that is not marked.

bar = np.array([[0.0, 0.0, 0.0], [1.2, 0.0, 0.0]])
ends_in_world = np.array([[-0.6, 0.1, 0.0], [0.6, 0.1, 0.0]])
views = np.array([0, 2, 4, 6, 8])
camera = truth.cameras[0]
clicks = np.stack([camera.project(truth.cams_from_world()[v].apply(ends_in_world)) for v in views])
clicks += rng.standard_normal(clicks.shape)
by_bar = fit_scale_to_object(bar, model.cams_from_world()[views], [camera] * 5, clicks, sigma_px=1.0)
print("bar:", by_bar)
scale_of_bar = 1.0 / float(by_bar.model_from_object.scale)
assert np.isclose(scale_of_bar, by_bar.scale)
assert abs(by_bar.scale - 2.5) < 4 * by_bar.sigma < 0.1

# Combine the two estimates. `agreed_scale` weights them by their standard deviations, so the result is more
# certain than each estimate.

estimates = [
    ScaleEstimate("positions", "GPS", scale_of_positions, by_positions.sigma, note="16 measured positions"),
    ScaleEstimate("length", "bar", by_bar.scale, by_bar.sigma),
]
combined = agreed_scale(estimates)
print(combined.in_words(), f"-> {combined.scale:.4f}")
assert abs(combined.scale - 2.5) < 4 * combined.sigma
assert combined.sigma < min(by_positions.sigma, by_bar.sigma)

# If a third estimate is wrong, here because a board was printed at 90 %, `agreed_scale` rejects it. If two
# estimates contradict each other, `agreed_scale` raises an error.

wrong = ScaleEstimate("board", "board", 0.9 * 2.5, 0.01)
print(
    "kept:",
    [e.name for e, kept in zip([*estimates, wrong], agreed_scale([*estimates, wrong]).kept_mask) if kept],
)
assert agreed_scale([*estimates, wrong]).kept_mask.tolist() == [True, True, False]
try:
    agreed_scale([estimates[0], wrong])
except DegenerateGeometryError as error:
    print("no scale:", error)
else:
    raise AssertionError("contradictory estimates must raise an error")

# Scale the model to meters. This changes lengths, but not pixels or reprojection errors.

metric = model.transformed(Similarity3(combined.scale, np.eye(3), np.zeros(3)))
distance_m = np.linalg.norm(np.diff(metric.camera_centers_in_world(), axis=0), axis=1).sum()
true_distance_m = np.linalg.norm(np.diff(truth.camera_centers_in_world(), axis=0), axis=1).sum()
print(f"distance traveled: {distance_m:.2f} m, true value {true_distance_m:.2f} m")
assert abs(distance_m / true_distance_m - 1.0) < 0.02
assert np.isclose(metric.mean_reprojection_error_px(), model.mean_reprojection_error_px())
