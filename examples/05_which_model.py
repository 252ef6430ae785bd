"""Which model: homography, F or E?

Two images may show a scene with depth, a plane, or a pure rotation of the camera. A fundamental matrix fits
all three, but is meaningless for a plane and for a rotation. `verify_pairs` compares the models and selects
the one that explains the matches best.
"""

import numpy as np

from epipole.geometry import Rotation3, decompose_homography
from epipole.robust import (
    PairKind,
    PairMatches,
    estimate_fundamental_matrix,
    estimate_homography,
    verify_pair,
    verify_pairs,
)
from epipole.synthetic.problems import two_view_problem

# Generate four image pairs with known solutions: 300 matches, 20 % outliers and half a pixel of noise. With
# photographs, use the pixels of matched keypoints, as on the page on epipolar geometry.

problems = {
    "depth": two_view_problem(300, 0.2, 0.5, seed=1, kind="general"),
    "plane": two_view_problem(300, 0.2, 0.5, seed=2, kind="planar"),
    "rotation": two_view_problem(300, 0.2, 0.5, seed=3, kind="rotation"),
    "forward": two_view_problem(300, 0.2, 0.5, seed=4, kind="forward"),
}
pairs = [PairMatches(p.pixels1, p.pixels2, p.camera1, p.camera2) for p in problems.values()]
geometries = dict(zip(problems, verify_pairs(pairs)))
for name, geometry in geometries.items():
    print(f"{name:10s} {geometry}")

# Each pair is classified correctly.

assert geometries["depth"].kind is PairKind.GENERAL
assert geometries["plane"].kind is PairKind.PLANAR
assert geometries["rotation"].kind is PairKind.ROTATION
assert geometries["forward"].kind is PairKind.GENERAL

# `verify_pairs` compares the models by Torr's criterion (GRIC, 1998): the squared residuals over the noise,
# each with an upper bound, plus penalties for the dimension of the model and for its number of parameters.
# Lower is better. NaN means that the model was not found.

for name, geometry in geometries.items():
    print(f"{name:10s} cost of F or E, H, rotation, no motion: {geometry.costs.round(0)}")
assert np.nanargmin(geometries["depth"].costs) == 0
assert np.nanargmin(geometries["plane"].costs) == 1
assert np.nanargmin(geometries["rotation"].costs) == 2

# For a scene with depth, the result is a relative pose. For a pure rotation, the translation is exactly zero
# instead of a random direction.

rotated, problem = geometries["rotation"].cam2_from_cam1, problems["rotation"]
difference = Rotation3(rotated.rotation) @ Rotation3(problem.cam2_from_cam1.rotation).inverse()
print(f"rotation error {np.degrees(difference.angle_rad()):.3f} degrees")
assert np.degrees(difference.angle_rad()) < 0.1 and not rotated.translation.any()

# For a plane, a whole family of fundamental matrices fits the matches. `estimate_fundamental_matrix` detects
# this and fails. The homography is unique.

plane = problems["plane"]
fundamental = estimate_fundamental_matrix(plane.pixels1, plane.pixels2)
homography = estimate_homography(plane.pixels1, plane.pixels2)
print("F of a plane:", fundamental.reason.value)
print("H of a plane:", homography)
assert not fundamental.success and homography.success

# With known intrinsics, a homography also determines the relative pose. Decomposing it gives up to four
# candidates, and the true pose is among them.

motions = decompose_homography(homography.model, plane.camera1.K, plane.camera2.K).cam2_from_cam1
rotations = [
    np.degrees((Rotation3(m.rotation) @ Rotation3(plane.cam2_from_cam1.rotation).inverse()).angle_rad())
    for m in motions
]
print("rotation errors of the candidates", np.round(rotations, 2), "degrees")
assert min(rotations) < 1.0

# If the focal length is only a guess, set `is_calibrated=False`. The pair is then classified as UNCALIBRATED:
# its fundamental matrix is valid, but its relative pose needs the intrinsics.

general = problems["depth"]
guessed = verify_pair(general.pixels1, general.pixels2, general.camera1, general.camera2, is_calibrated=False)
print("with guessed intrinsics:", guessed.kind.name)
assert guessed.kind is PairKind.UNCALIBRATED
