"""Epipolar geometry of two images

The match of a point in one image lies on a line in the other image, and the relative pose of the two cameras
determines this line. This page matches keypoints of two rendered images, estimates the fundamental matrix,
the essential matrix and the relative pose, and compares the pose with the true one.
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

# Render two images of a small courtyard. To use photographs, read them as gray images: `gray1 =
# epipole.io.images.photographs.read_gray("one.jpg")`.

camera = epipole.Camera("PINHOLE", 480, 320, [380.0, 380.0, 239.5, 159.5])
cams_from_world = courtyard_views(24)[[8, 13]]
images = [
    render(courtyard(), camera, view, noise_sigma=2.0, seed=n).rgb for n, view in enumerate(cams_from_world)
]
gray1, gray2 = (cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in images)

# Detect keypoints with RootSIFT descriptors. Match mutual nearest neighbors that pass the ratio test. Some
# of the matches are wrong.

features1, features2 = detect_features(gray1), detect_features(gray2)
pairs = match_descriptors(features1.descriptors, features2.descriptors)
pixels1, pixels2 = features1.pixels[pairs[:, 0]], features2.pixels[pairs[:, 1]]
print(f"{len(features1)} and {len(features2)} keypoints, {len(pairs)} matches")
assert len(pairs) > 200

# Uncalibrated matches determine the fundamental matrix F, with x2^T F x1 = 0. The result includes the
# inliers, the standard deviation of the pixel noise, and whether the estimation succeeded. A failed
# estimation does not raise an exception.

found_f = estimate_fundamental_matrix(pixels1, pixels2)
print("F:", found_f, f"noise {found_f.noise_px:.2f} px")
assert found_f.success

# Residuals are Sampson distances in pixels: the first-order distance by which a match has to move to satisfy
# the epipolar constraint. The distance of a pixel to its epipolar line uses the error in one image only, and
# is never smaller.

inliers = found_f.inlier_mask
residuals_px = sampson_error(found_f.model, pixels1, pixels2)
lines2 = epipolar_lines(found_f.model, pixels1)
to_line_px = point_line_distance(pixels2, lines2)
print(f"median residual {np.median(residuals_px[inliers]):.2f} px")
print(f"median distance from the line {np.median(to_line_px[inliers]):.2f} px")
assert np.allclose(residuals_px, found_f.residuals_px, rtol=1e-6, atol=1e-9)
assert (residuals_px <= to_line_px + 1e-9).all() and np.median(residuals_px[inliers]) < 0.5

# With known intrinsics, the same matches determine the essential matrix E. It is close to K2^T F K1. Both
# matrices are defined up to sign.

found_e = estimate_essential_matrix(pixels1, pixels2, camera, camera)
e_from_f = essential_from_fundamental(found_f.model, camera.K, camera.K)
similarity = abs(float((e_from_f * found_e.model).sum())) / np.linalg.norm(e_from_f)
print(f"cosine between E and K2^T F K1: {similarity:.4f}")
assert found_e.success and similarity > 0.99

# E encodes a rotation and the direction of the translation. Two images do not determine the length of the
# translation, so the estimate has length one.

found = estimate_relative_pose(pixels1, pixels2, camera, camera)
truth = cams_from_world[1] @ cams_from_world[0].inverse()
rotation_deg = np.degrees((Rotation3(found.model.rotation) @ Rotation3(truth.rotation).inverse()).angle_rad())
cosine = found.model.translation @ truth.translation / np.linalg.norm(truth.translation)
direction_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
print(f"rotation error {rotation_deg:.3f} degrees, direction error {direction_deg:.3f} degrees")
assert np.isclose(np.linalg.norm(found.model.translation), 1.0)
assert rotation_deg < 0.2 and direction_deg < 1.0

# The covariance describes the uncertainty of the pose. It refers to xi = (translation, rotation) in exp(xi) @
# cam2_from_cam1.

sigma = np.sqrt(np.diag(found.covariance))
print("standard deviation of the rotation in degrees:", np.degrees(sigma[3:]).round(4))
assert np.radians(rotation_deg) < 5 * np.linalg.norm(sigma[3:])

# The true pose fits these matches about as well as the estimate does. The remaining residuals are keypoint
# noise.

true_f = fundamental_from_essential(essential_from_cam2_from_cam1(truth), camera.K, camera.K)
median_px = [np.median(sampson_error(f, pixels1[inliers], pixels2[inliers])) for f in (true_f, found_f.model)]
print(f"median residual under the true pose {median_px[0]:.2f} px, under F {median_px[1]:.2f} px")
assert median_px[0] < 1.5 * median_px[1]
