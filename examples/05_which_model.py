"""Which model: homography, F or E?

Two images may show a scene with depth, a plane, or a camera that only turned. A fundamental matrix "fits"
all three, and is meaningless in two of them. `verify_pairs` lets the models compete, and names the one that
explains the matches.
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

# Four pairs of images with known answers: 300 matches, one in five wrong, half a pixel of noise. With
# photographs, the pixels are those of matched keypoints, as on the page on epipolar geometry.

problems = {
    "with depth": two_view_problem(300, 0.2, 0.5, seed=1, kind="general"),
    "a plane": two_view_problem(300, 0.2, 0.5, seed=2, kind="planar"),
    "turned": two_view_problem(300, 0.2, 0.5, seed=3, kind="rotation"),
    "ahead": two_view_problem(300, 0.2, 0.5, seed=4, kind="forward"),
}
pairs = [PairMatches(p.pixels1, p.pixels2, p.camera1, p.camera2) for p in problems.values()]
geometries = dict(zip(problems, verify_pairs(pairs)))
for name, geometry in geometries.items():
    print(f"{name:10s} {geometry}")

# The kind is what the matches say, not what was hoped for.

assert geometries["with depth"].kind is PairKind.GENERAL
assert geometries["a plane"].kind is PairKind.PLANAR
assert geometries["turned"].kind is PairKind.ROTATION
assert geometries["ahead"].kind is PairKind.GENERAL

# Models are compared by Torr's criterion (GRIC, 1998): squared residuals over the noise, each at most a
# bound, plus a price for the dimension of what the model allows and one for its parameters. Lower is better;
# NaN means that the model was not found.

for name, geometry in geometries.items():
    print(f"{name:10s} epipolar, plane, rotation, rest: {geometry.costs.round(0)}")
assert np.nanargmin(geometries["with depth"].costs) == 0
assert np.nanargmin(geometries["a plane"].costs) == 1
assert np.nanargmin(geometries["turned"].costs) == 2

# A pair with depth gives a motion. One that only turned gives a rotation and no translation at all, instead
# of a random one.

rotated, problem = geometries["turned"].cam2_from_cam1, problems["turned"]
difference = Rotation3(rotated.rotation) @ Rotation3(problem.cam2_from_cam1.rotation).inverse()
print(f"the rotation is off by {np.degrees(difference.angle_rad()):.3f} degrees")
assert np.degrees(difference.angle_rad()) < 0.1 and not rotated.translation.any()

# What goes wrong without the question: on the plane a whole family of fundamental matrices fits, and the
# estimator says that it cannot choose. The homography is exact there.

plane = problems["a plane"]
fundamental = estimate_fundamental_matrix(plane.pixels1, plane.pixels2)
homography = estimate_homography(plane.pixels1, plane.pixels2)
print("F of a plane:", fundamental.reason.value)
print("H of a plane:", homography)
assert not fundamental.success and homography.success

# A homography between known lenses still holds the motion: up to four of them, of which the true one is among
# these.

motions = decompose_homography(homography.model, plane.camera1.K, plane.camera2.K).cam2_from_cam1
rotations = [
    np.degrees((Rotation3(m.rotation) @ Rotation3(plane.cam2_from_cam1.rotation).inverse()).angle_rad())
    for m in motions
]
print("candidates off by", np.round(rotations, 2), "degrees")
assert min(rotations) < 1.0

# Where a focal length is only a guess, a pair is UNCALIBRATED: its matrix is right, its motion waits for the
# lens.

general = problems["with depth"]
guessed = verify_pair(general.pixels1, general.pixels2, general.camera1, general.camera2, is_calibrated=False)
print("with guessed lenses:", guessed.kind.name)
assert guessed.kind is PairKind.UNCALIBRATED
