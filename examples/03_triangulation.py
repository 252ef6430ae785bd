"""Triangulation, and how sure a depth is

Two rays that meet are a point. How well their angle fixes the point decides everything that is made of points
later, so this page measures it: the error of the depth against the baseline, the noise, and what the
covariance says.
"""

import numpy as np

import epipole
from epipole.geometry import Rigid3
from epipole.robust import PointReason, point_covariances, triangulate_points

# One point four metres away, and two cameras side by side that look the same way. The baseline is the
# distance between them.

camera = epipole.Camera("PINHOLE", 1280, 960, [800.0, 800.0, 639.5, 479.5])
point_in_world = np.array([[0.1, 0.2, 4.0]])


def cameras_at(*positions):
    """cams_from_world of cameras that all look along z, from places on the x axis."""
    translation = np.array([[-x, 0.0, 0.0] for x in positions])
    return Rigid3(np.tile(np.eye(3), (len(positions), 1, 1)), translation)


def seen_by(cams_from_world, points):
    """(views, n, 2) exact pixels."""
    return np.stack([camera.project(view.apply(points)) for view in cams_from_world])


# Exact pixels give the point back.

pair = cameras_at(0.0, 0.2)
found = triangulate_points(pair, camera, seen_by(pair, point_in_world))
print("found", found.points_in_world[0], "angle", np.degrees(found.angles_rad[0]).round(2), "degrees")
assert np.allclose(found.points_in_world, point_in_world, atol=1e-9)

# Half a pixel of noise, two thousand times, for three baselines. The covariance is first order, of the noise
# alone, and the cameras are taken as exact. Its prediction for the depth is about Z^2 / (f B) sqrt(2) sigma.

rng = np.random.default_rng(0)
noise_px, count = 0.5, 2000
spread_m, stated_m = {}, {}
for baseline in (0.1, 0.2, 0.8):
    cams = cameras_at(0.0, baseline)
    pixels = np.repeat(seen_by(cams, point_in_world), count, axis=1)
    pixels += noise_px * rng.standard_normal(pixels.shape)
    depth = triangulate_points(cams, camera, pixels).points_in_world[:, 2]
    covariance = point_covariances(cams, camera, point_in_world, np.ones((2, 1), bool), noise_px)
    spread_m[baseline], stated_m[baseline] = np.std(depth), np.sqrt(covariance[0, 2, 2])
    by_hand = 4.0**2 / (800.0 * baseline) * np.sqrt(2.0) * noise_px
    print(
        f"baseline {baseline} m: depth off by {spread_m[baseline]:.3f} m, stated {stated_m[baseline]:.3f} m"
    )
    assert abs(spread_m[baseline] / stated_m[baseline] - 1.0) < 0.1
    assert abs(by_hand / stated_m[baseline] - 1.0) < 0.02

# Twice the baseline halves the error. Across the ray the point is known far better than along it, even by the
# widest pair.

assert abs(stated_m[0.1] / stated_m[0.2] - 2.0) < 0.02
across, along = np.sqrt(covariance[0, 0, 0]), np.sqrt(covariance[0, 2, 2])
print(f"across {1000 * across:.1f} mm, along {1000 * along:.1f} mm")
assert along > 3 * across

# More views help in two ways: each adds its pixels, and a wrong one can be told. Here the third of five views
# is 40 px off; with a threshold it is left out.

cams = cameras_at(0.0, 0.2, 0.4, 0.6, 0.8)
pixels = seen_by(cams, point_in_world)
pixels[2, 0] += [0.0, 40.0]
robust = triangulate_points(cams, camera, pixels, max_error_px=2.0)
print("views that agree:", robust.inlier_mask[:, 0])
assert robust.inlier_mask[:, 0].tolist() == [True, True, False, True, True]
assert np.allclose(robust.points_in_world, point_in_world, atol=1e-6)
assert not np.allclose(triangulate_points(cams, camera, pixels).points_in_world, point_in_world, atol=0.01)

# A point that cannot be had says why: seen once, or with rays so nearly parallel that the depth means
# nothing.

pixels = seen_by(pair, np.array([[0.1, 0.2, 4.0], [0.1, 0.2, 400.0]]))
pixels[1, 0] = np.nan
reasons = triangulate_points(pair, camera, pixels, min_angle_rad=np.deg2rad(0.5)).reason
print([PointReason(int(reason)).name for reason in reasons])
assert reasons.tolist() == [PointReason.TOO_FEW_VIEWS, PointReason.PARALLEL]
