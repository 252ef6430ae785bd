"""Epipolar geometry of two images

A point of one image lies on a line of the other, and that line follows from where the two cameras stand.
Here keypoints are found and matched in two rendered images, the fundamental and the essential matrix are
estimated, and the relative pose that comes out is compared with the true one.
"""

import cv2
import numpy as np

import epipole
from epipole.features import detect_features, match_descriptors
from epipole.geometry import (
    Rotation3,
    epipolar_lines,
    essential_from_cam2_from_cam1,
    essential_from_fundamental,
    fundamental_from_essential,
    point_line_distance,
    sampson_error,
)
from epipole.robust import estimate_essential_matrix, estimate_fundamental_matrix, estimate_relative_pose
from epipole.synthetic import courtyard, courtyard_views, render

# Two images of a small courtyard. With photographs, read grey images instead: `grey1 =
# epipole.io.images.photographs.read_grey("one.jpg")`.

camera = epipole.Camera("PINHOLE", 480, 320, [380.0, 380.0, 239.5, 159.5])
cams_from_world = courtyard_views(24)[[8, 13]]
images = [
    render(courtyard(), camera, view, noise_sigma=2.0, seed=n).rgb for n, view in enumerate(cams_from_world)
]
grey1, grey2 = (cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in images)

# Keypoints with root-SIFT descriptors, then pairs of mutual nearest neighbours that pass the ratio test. Some
# are wrong.

features1, features2 = detect_features(grey1), detect_features(grey2)
pairs = match_descriptors(features1.descriptors, features2.descriptors)
pixels1, pixels2 = features1.pixels[pairs[:, 0]], features2.pixels[pairs[:, 1]]
print(f"{len(features1)} and {len(features2)} keypoints, {len(pairs)} matches")
assert len(pairs) > 200

# Without any calibration, matches give the fundamental matrix, x2^T F x1 = 0. An estimate says which matches
# agree, how wide their noise is, and whether it succeeded: a failure is data, not an exception.

found_f = estimate_fundamental_matrix(pixels1, pixels2)
print("F:", found_f, f"noise {found_f.noise_px:.2f} px")
assert found_f.success

# Residuals are Sampson distances in pixels: how far a match must move to satisfy the equation, to first
# order. The distance of a pixel from the line of its partner says the same in one image alone.

right = found_f.inlier_mask
residuals_px = sampson_error(found_f.model, pixels1, pixels2)
lines2 = epipolar_lines(found_f.model, pixels1)
to_line_px = point_line_distance(pixels2, lines2)
print(f"median residual {np.median(residuals_px[right]):.2f} px")
print(f"median distance from the line {np.median(to_line_px[right]):.2f} px")
assert np.allclose(residuals_px, found_f.residuals_px, rtol=1e-6, atol=1e-9)
assert (residuals_px <= to_line_px + 1e-9).all() and np.median(residuals_px[right]) < 0.5

# With the lenses known, the same matches give the essential matrix, and K2^T F K1 is nearly that one. Both
# have a free sign.

found_e = estimate_essential_matrix(pixels1, pixels2, camera, camera)
from_f = essential_from_fundamental(found_f.model, camera.K, camera.K)
alike = abs(float((from_f * found_e.model).sum())) / np.linalg.norm(from_f)
print(f"cosine between E and K2^T F K1: {alike:.4f}")
assert found_e.success and alike > 0.99

# E is a rotation and a direction. The length of the way cannot be known from two images, so that of the
# translation is one.

found = estimate_relative_pose(pixels1, pixels2, camera, camera)
true = cams_from_world[1] @ cams_from_world[0].inverse()
rotation_deg = np.degrees((Rotation3(found.model.rotation) @ Rotation3(true.rotation).inverse()).angle_rad())
cosine = found.model.translation @ true.translation / np.linalg.norm(true.translation)
way_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
print(f"rotation off by {rotation_deg:.3f} degrees, direction by {way_deg:.3f} degrees")
assert np.isclose(np.linalg.norm(found.model.translation), 1.0)
assert rotation_deg < 0.2 and way_deg < 1.0

# The covariance tells how well the pose is known: (translation, rotation) of xi in exp(xi) @ cam2_from_cam1.

sigma = np.sqrt(np.diag(found.covariance))
print("sigma of the rotation in degrees:", np.degrees(sigma[3:]).round(4))
assert np.radians(rotation_deg) < 5 * np.linalg.norm(sigma[3:])

# The true pose explains these matches as well as the estimate does: what is left is the keypoints' own noise.

true_f = fundamental_from_essential(essential_from_cam2_from_cam1(true), camera.K, camera.K)
left_px = [np.median(sampson_error(f, pixels1[right], pixels2[right])) for f in (true_f, found_f.model)]
print(f"median residual under the true pose {left_px[0]:.2f} px, under F {left_px[1]:.2f} px")
assert left_px[0] < 1.5 * left_px[1]
