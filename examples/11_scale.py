"""Scale: metres for a model

Images of one camera tell shapes, not lengths. Anything known besides fixes the unit: measured places, a
length, a marker of known size, odometry. Each gives a scale with its deviation, and together they say whether
they agree.
"""

import numpy as np

from epipole.errors import DegenerateGeometryError
from epipole.geometry import Similarity3
from epipole.scale import ScaleEstimate, agreed_scale, fit_scale_to_object, fit_scale_to_positions
from epipole.synthetic.problems import bundle_problem

# A made-up model of 16 images in metres, and the same model as a reconstruction would give it: in a world
# and a unit of its own. Here one unit is 2.5 metres; that is what is to be found.

rng = np.random.default_rng(3)
true = bundle_problem(16, 300, 5, noise_px=0.5, seed=2).truth
rotation = Similarity3.exp([1.0, -2.0, 0.5, 0.3, -0.8, 0.4, 0.0])
model = true.transformed(Similarity3(1 / 2.5, rotation.rotation, rotation.translation))
print(model)

# A real one: `model = epipole.reconstruct("IMAGES", "OUT").model`; and `epipole.reconstruct("IMAGES", "OUT",
# positions="places.txt", lengths="lengths.txt", tag_size_m=0.12)` does all of this page from files.

# Measured places: the cameras' positions by GPS or a total station, wrong by 3 cm in each coordinate. The
# similarity onto them is fitted (Umeyama 1991), and its scale has the deviation that these errors leave.

measured = true.camera_centers_in_world() + 0.03 * rng.standard_normal((16, 3))
by_places = fit_scale_to_positions(model.camera_centers_in_world(), measured, sigma=0.03)
print("places:", by_places)
scale_of_places = float(by_places.world_from_model.scale)
assert abs(scale_of_places - 2.5) < 4 * by_places.sigma < 0.1

# A known length: a bar of 1.2 m, of which both ends are clicked in five images, a pixel wrong. Pixels are
# told image by image, with NaN where an end was not clicked.

bar = np.array([[0.0, 0.0, 0.0], [1.2, 0.0, 0.0]])
ends_in_world = np.array([[-0.6, 0.1, 0.0], [0.6, 0.1, 0.0]])
views = np.array([0, 2, 4, 6, 8])
camera = true.cameras[0]
clicks = np.stack([camera.project(true.cams_from_world()[v].apply(ends_in_world)) for v in views])
clicks += rng.standard_normal(clicks.shape)
by_bar = fit_scale_to_object(bar, model.cams_from_world()[views], [camera] * 5, clicks, sigma_px=1.0)
print("bar:", by_bar)
scale_of_bar = 1.0 / float(by_bar.model_from_object.scale)
assert np.isclose(scale_of_bar, by_bar.scale)
assert abs(by_bar.scale - 2.5) < 4 * by_bar.sigma < 0.1

# Together: estimates that agree are averaged by their deviations, so that the result is surer than each.

estimates = [
    ScaleEstimate("positions", "GPS", scale_of_places, by_places.sigma, note="16 measured places"),
    ScaleEstimate("length", "bar", by_bar.scale, by_bar.sigma),
]
agreed = agreed_scale(estimates)
print(agreed.in_words(), f"-> {agreed.scale:.4f}")
assert abs(agreed.scale - 2.5) < 4 * agreed.sigma
assert agreed.sigma < min(by_places.sigma, by_bar.sigma)

# A third that is wrong (a board printed at 90 %) is outvoted and named; two that contradict each other give
# no metres at all.

wrong = ScaleEstimate("board", "board", 0.9 * 2.5, 0.01)
print(
    "kept:",
    [e.name for e, kept in zip([*estimates, wrong], agreed_scale([*estimates, wrong]).kept_mask) if kept],
)
assert agreed_scale([*estimates, wrong]).kept_mask.tolist() == [True, True, False]
try:
    agreed_scale([estimates[0], wrong])
except DegenerateGeometryError as error:
    print("no metres:", error)
else:
    raise AssertionError("a contradiction must not give a scale")

# The model in metres. Pixels do not change, lengths do: cameras, points, and what is seen between them.

metric = model.transformed(Similarity3(agreed.scale, np.eye(3), np.zeros(3)))
way_m = np.linalg.norm(np.diff(metric.camera_centers_in_world(), axis=0), axis=1).sum()
true_way_m = np.linalg.norm(np.diff(true.camera_centers_in_world(), axis=0), axis=1).sum()
print(f"the way of the camera: {way_m:.2f} m, in truth {true_way_m:.2f} m")
assert abs(way_m / true_way_m - 1.0) < 0.02
assert np.isclose(metric.mean_reprojection_error_px(), model.mean_reprojection_error_px())
