"""Solvers for poses: exact data of every kind contain the truth; noisy data come near; degenerate data give nothing."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.solvers import (
    solve_generalized_p3p,
    solve_p3p,
    solve_p4pf,
    solve_pnp,
    solve_upright_p2p,
    solve_upright_relative_three_point,
)
from epipole.solvers._polynomial_kernels import cubic_roots
from epipole.solvers._quadrics_kernels import intersect_quadrics, quadrics_workspace
from whole import IS_WHOLE


def anywhere(rng):
    return Rigid3(Rotation3.from_quat_wxyz(rng.normal(size=4)).matrix, 5.0 * rng.normal(size=3))


def turned_about_y(rng):
    return Rigid3(Rotation3.exp(np.array([0, rng.uniform(-3, 3), 0])).matrix, 5.0 * rng.normal(size=3))


def seen(rng, motion, count, planar=False):
    """Points in the world whose images are points in front of the camera."""
    in_cam = rng.uniform([-2, -1.5, 4], [2, 1.5, 9], (count, 3))
    if planar:
        in_cam[:, 2] = 6.0 + 0.3 * in_cam[:, 0] - 0.2 * in_cam[:, 1]
    return motion.inverse().apply(in_cam), in_cam


def nearest(found, truth):
    both = np.concatenate([found.rotation.reshape(-1, 9), found.translation], axis=1)
    return np.abs(both - np.append(truth.rotation.ravel(), truth.translation)).max(axis=1).min(initial=np.inf)


@pytest.mark.parametrize("scale", [1.0, 1e-4, 1e6])
def test_p3p_contains_the_truth(rng, scale):
    for _ in range(300):
        truth = anywhere(rng)
        points, in_cam = seen(rng, truth, 3)
        found = solve_p3p(scale * points, in_cam)
        assert len(found) <= 4
        assert nearest(Rigid3(found.rotation, found.translation / scale), truth) < 1e-5
        again = found.rotation @ (scale * points).T + found.translation[:, :, None]
        rays = in_cam / np.linalg.norm(in_cam, axis=1, keepdims=True)
        unit = np.swapaxes(again, 1, 2) / np.linalg.norm(again, axis=1)[:, :, None]
        np.testing.assert_allclose(unit, np.broadcast_to(rays, unit.shape), atol=1e-6)


def test_collinear_points_give_p3p_nothing(rng):
    points = np.outer([1.0, 2.0, 3.0], [1.0, 1.0, 1.0]) + np.array([0, 0, 4.0])
    assert len(solve_p3p(points, points)) == 0
    assert len(solve_p3p(np.ones((3, 3)), points)) == 0
    assert len(solve_p3p(points[[0, 0, 1]], points[[0, 0, 1]])) == 0


def test_generalized_p3p_contains_the_truth(rng):
    for _ in range(200):
        truth = anywhere(rng)
        points, in_rig = seen(rng, truth, 3)
        origins = 0.5 * rng.normal(size=(3, 3))
        found = solve_generalized_p3p(points, origins, in_rig - origins)
        assert nearest(found, truth) < 1e-4


def test_p4pf_contains_the_truth_and_needs_depth(rng):
    missed = 0
    for _ in range(200):
        truth = anywhere(rng)
        points, in_cam = seen(rng, truth, 4)
        focal = rng.uniform(300, 3000)
        found = solve_p4pf(points, focal * in_cam[:, :2] / in_cam[:, 2:])
        error = np.abs(found.focal_px / focal - 1.0) + np.abs(
            found.cam_from_world.rotation - truth.rotation
        ).max(axis=(1, 2))
        missed += not error.min(initial=np.inf) < 1e-4
    assert missed <= 2
    points, in_cam = seen(rng, truth, 4, planar=True)
    assert len(solve_p4pf(points, 800 * in_cam[:, :2] / in_cam[:, 2:]).focal_px) == 0


def test_upright_solvers_contain_the_truth(rng):
    for _ in range(200):
        truth = turned_about_y(rng)
        points, in_cam = seen(rng, truth, 2)
        assert nearest(solve_upright_p2p(points, in_cam), truth) < 1e-6
        motion = turned_about_y(rng)
        motion = Rigid3(motion.rotation, motion.translation / np.linalg.norm(motion.translation))
        first = rng.uniform([-2, -1.5, 4], [2, 1.5, 9], (3, 3))
        assert nearest(solve_upright_relative_three_point(first, motion.apply(first)), motion) < 1e-5


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("count", [4, 6, 50])
def test_pnp_is_exact_without_noise_and_least_squares_with_it(rng, count, planar):
    for _ in range(20 if IS_WHOLE else 8):
        truth = anywhere(rng)
        points, in_cam = seen(rng, truth, count, planar)
        assert nearest(Rigid3(*(a[None] for a in _parts(solve_pnp(points, in_cam)))), truth) < 1e-5
    rays = in_cam / np.linalg.norm(in_cam, axis=1, keepdims=True) + 1e-3 * rng.normal(size=in_cam.shape)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    found = solve_pnp(points, rays)

    def distances(xi):
        x = (Rigid3.exp(xi) @ found).apply(points)
        return (x - (x * rays).sum(axis=1, keepdims=True) * rays).ravel()

    best = least_squares(distances, np.zeros(6), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert (distances(np.zeros(6)) ** 2).sum() <= 2 * best.cost * (1 + 1e-6) + 1e-15


def _parts(motion):
    return motion.rotation, motion.translation


def test_pnp_refuses_what_fixes_no_pose(rng):
    line = np.outer(np.arange(6.0), [1.0, 2.0, 0.5])
    with pytest.raises(DegenerateGeometryError):
        solve_pnp(line, line + np.array([0, 0, 5]))
    with pytest.raises(DegenerateGeometryError):
        solve_pnp(np.ones((6, 3)), np.ones((6, 3)))
    with pytest.raises(ShapeError):
        solve_pnp(np.ones((3, 3)), np.ones((3, 3)))


def test_three_quadrics_meet_where_they_were_made_to(rng):
    workspace, out = quadrics_workspace(), np.empty((8, 3))
    for _ in range(300):
        x, y, z = point = rng.normal(size=3)
        monomials = np.array([x * x, x * y, x * z, y * y, y * z, z * z, x, y, z, 1.0])
        quadrics = rng.normal(size=(3, 10))
        quadrics[:, 9] -= quadrics @ monomials
        count = intersect_quadrics(quadrics, out, workspace)
        assert 1 <= count <= 8
        assert np.abs(out[:count] - point).max(axis=1).min() < 1e-6
    assert intersect_quadrics(np.zeros((3, 10)), out, workspace) == 0


def test_cubics_with_known_roots(rng):
    out = np.empty(3)
    for _ in range(300):
        roots = np.sort(rng.normal(size=3)) * 10.0 ** rng.uniform(-2, 2)
        c = rng.normal() * np.poly(roots)
        assert cubic_roots(*c, out) == 3
        np.testing.assert_allclose(np.sort(out), roots, rtol=1e-6, atol=1e-6 * np.abs(roots).max())
    assert cubic_roots(0.0, 0.0, 0.0, 1.0, out) == 0
    assert cubic_roots(0.0, 0.0, 2.0, 1.0, out) == 1 and out[0] == -0.5
    assert cubic_roots(0.0, 1.0, -3.0, 2.0, out) == 2
    assert cubic_roots(0.0, 1.0, 0.0, 2.0, out) == 0
    assert cubic_roots(1.0, 0.0, 0.0, -8.0, out) == 1 and abs(out[0] - 2.0) < 1e-12
    assert cubic_roots(np.nan, 1.0, 1.0, 1.0, out) == 0
