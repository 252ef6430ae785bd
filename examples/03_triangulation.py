"""Triangulation and the uncertainty of depth

Two rays that intersect determine a point. The angle between them determines how accurate the point is. This
page compares the depth error with the covariance for several baselines.
"""

import numpy as np

import epipole
from epipole.geometry import Rigid3
from epipole.robust import PointReason, point_covariances, triangulate_points

# Two cameras, side by side with parallel optical axes, observe a point at a depth of four meters. The
# baseline is the distance between the cameras.

camera = epipole.Camera("PINHOLE", 1280, 960, [800.0, 800.0, 639.5, 479.5])
point_in_world = np.array([[0.1, 0.2, 4.0]])


def cameras_at(*positions):
    """Return `cams_from_world` of cameras that look along z, at these x coordinates."""
    translation = np.array([[-x, 0.0, 0.0] for x in positions])
    return Rigid3(np.tile(np.eye(3), (len(positions), 1, 1)), translation)


def project_to(cams_from_world, points):
    """Return the noise-free pixels, (views, n, 2)."""
    return np.stack([camera.project(view.apply(points)) for view in cams_from_world])


# From exact pixels, `triangulate_points` recovers the point.

pair = cameras_at(0.0, 0.2)
found = triangulate_points(pair, camera, project_to(pair, point_in_world))
print("found", found.points_in_world[0], "angle", np.degrees(found.angles_rad[0]).round(2), "degrees")
assert np.allclose(found.points_in_world, point_in_world, atol=1e-9)

# Add half a pixel of noise 2000 times, for three baselines. The covariance is a first-order approximation
# that includes pixel noise only and treats the camera poses as exact. It predicts a depth error of about
# sqrt(2) sigma Z^2 / (f B).

rng = np.random.default_rng(0)
noise_px, count = 0.5, 2000
measured_m, predicted_m = {}, {}
for baseline in (0.1, 0.2, 0.8):
    cams = cameras_at(0.0, baseline)
    pixels = np.repeat(project_to(cams, point_in_world), count, axis=1)
    pixels += noise_px * rng.standard_normal(pixels.shape)
    depth = triangulate_points(cams, camera, pixels).points_in_world[:, 2]
    covariance = point_covariances(cams, camera, point_in_world, np.ones((2, 1), bool), noise_px)
    measured_m[baseline], predicted_m[baseline] = np.std(depth), np.sqrt(covariance[0, 2, 2])
    approximate_m = 4.0**2 / (800.0 * baseline) * np.sqrt(2.0) * noise_px
    print(
        f"baseline {baseline} m: error {measured_m[baseline]:.3f} m, predicted {predicted_m[baseline]:.3f} m"
    )
    assert abs(measured_m[baseline] / predicted_m[baseline] - 1.0) < 0.1
    assert abs(approximate_m / predicted_m[baseline] - 1.0) < 0.02

# Twice the baseline halves the error. Even with the widest baseline, the point is known far better across the
# ray than along it.

assert abs(predicted_m[0.1] / predicted_m[0.2] - 2.0) < 0.02
across, along = np.sqrt(covariance[0, 0, 0]), np.sqrt(covariance[0, 2, 2])
print(f"across {1000 * across:.1f} mm, along {1000 * along:.1f} mm")
assert along > 3 * across

# More views help in two ways: each view adds an observation, and with more than two views an outlier can be
# detected. Here the third of five observations is wrong by 40 px, and `triangulate_points` rejects it because
# of `max_error_px`.

cams = cameras_at(0.0, 0.2, 0.4, 0.6, 0.8)
pixels = project_to(cams, point_in_world)
pixels[2, 0] += [0.0, 40.0]
robust = triangulate_points(cams, camera, pixels, max_error_px=2.0)
print("inlier views:", robust.inlier_mask[:, 0])
assert robust.inlier_mask[:, 0].tolist() == [True, True, False, True, True]
assert np.allclose(robust.points_in_world, point_in_world, atol=1e-6)
assert not np.allclose(triangulate_points(cams, camera, pixels).points_in_world, point_in_world, atol=0.01)

# If a point cannot be triangulated, `reason` says why. Here one point has a single observation, and the rays
# of the other are too close to parallel to determine its depth.

pixels = project_to(pair, np.array([[0.1, 0.2, 4.0], [0.1, 0.2, 400.0]]))
pixels[1, 0] = np.nan
reasons = triangulate_points(pair, camera, pixels, min_angle_rad=np.deg2rad(0.5)).reason
print([PointReason(int(reason)).name for reason in reasons])
assert reasons.tolist() == [PointReason.TOO_FEW_VIEWS, PointReason.SMALL_ANGLE]
