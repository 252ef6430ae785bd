"""Triangulation: exact rays, noise, infinity, no baseline, too few rays."""

import numpy as np
import pytest
from scipy.optimize import minimize

from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3, ray_angles_rad, triangulate_linear, triangulate_two_view

SIDEWAYS = Rigid3(np.eye(3), np.array([-1.0, 0.0, 0.0]))


def ring_of_cameras(count: int, rng: np.random.Generator) -> Rigid3:
    rotated = Rigid3.exp(np.column_stack([rng.normal(size=(count, 3)), rng.normal(size=(count, 3))]))
    return Rigid3(np.eye(3)[None], np.array([[0.0, 0.0, 8.0]])) @ rotated


@pytest.mark.parametrize("count", [2, 3, 20])
def test_linear_triangulation_of_exact_rays_is_exact(count: int, rng: np.random.Generator) -> None:
    for point in rng.normal(size=(10, 3)):
        cams_from_world = ring_of_cameras(count, rng)
        rays = cams_from_world.apply(point) * rng.uniform(0.01, 100, (count, 1))
        np.testing.assert_allclose(triangulate_linear(cams_from_world, rays), point, atol=1e-11)
        # A ray's sign does not matter to a line.
        np.testing.assert_allclose(triangulate_linear(cams_from_world, -rays), point, atol=1e-11)


def test_linear_triangulation_minimizes_its_algebraic_error(rng: np.random.Generator) -> None:
    cams_from_world = ring_of_cameras(6, rng)
    point = np.array([0.2, -0.4, 0.3])
    rays = cams_from_world.apply(point) + 0.02 * rng.normal(size=(6, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    unit = np.abs(cams_from_world.translation).max()

    def error(x: np.ndarray) -> float:
        across = np.cross(rays, cams_from_world.apply(x))
        return float((across**2).sum() / ((x**2).sum() + unit**2))

    found = triangulate_linear(cams_from_world, rays)
    best = minimize(error, point, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-16})
    np.testing.assert_allclose(found, best.x, atol=1e-5)
    assert np.linalg.norm(found - point) < 0.2


def test_linear_triangulation_does_not_depend_on_the_unit(rng: np.random.Generator) -> None:
    cams_from_world = ring_of_cameras(4, rng)
    rays = cams_from_world.apply([0.1, 0.2, 0.3]) + 0.01 * rng.normal(size=(4, 3))
    found = triangulate_linear(cams_from_world, rays)
    for unit in (1e-6, 1e6):
        scaled = Rigid3(cams_from_world.rotation, unit * cams_from_world.translation)
        np.testing.assert_allclose(triangulate_linear(scaled, rays), unit * found, rtol=1e-9)


def test_a_point_at_infinity_is_not_finite(rng: np.random.Generator) -> None:
    direction = np.array([0.6, 0.0, 0.8])
    for count in [2] * 50 + [5] * 50 + [100]:
        cams_from_world = ring_of_cameras(count, rng)
        rays = cams_from_world.rotation @ direction
        assert not np.isfinite(triangulate_linear(cams_from_world, rays)).any()
    # A far point has its digits still.
    far = 1e8 * direction
    np.testing.assert_allclose(
        triangulate_linear(cams_from_world, cams_from_world.apply(far)), far, rtol=1e-6, atol=1.0
    )


def test_turning_on_the_spot_gives_no_point(rng: np.random.Generator) -> None:
    rotations = Rigid3.exp(np.column_stack([np.zeros((4, 3)), 0.3 * rng.normal(size=(4, 3))]))
    for origin in (np.zeros(3), np.array([3.0, -2.0, 1.0])):
        on_the_spot = rotations @ Rigid3(np.eye(3), -origin)
        rays = on_the_spot.apply([0.3, 0.4, 9.0])
        assert np.isnan(triangulate_linear(on_the_spot, rays)).all()


@pytest.mark.parametrize("count", [0, 1])
def test_one_ray_is_too_few(count: int) -> None:
    with pytest.raises(DegenerateGeometryError, match=f"at least 2 rays, got {count}"):
        triangulate_linear(Rigid3.identity(count), np.ones((count, 3)))


def test_bad_rays_are_named() -> None:
    with pytest.raises(ShapeError, match="rays must be finite"):
        triangulate_linear(Rigid3.identity(2), [[0.0, 0, 1], [np.nan, 0, 1]])
    with pytest.raises(ShapeError, match="cams_from_world has 2, rays has 3"):
        triangulate_linear(Rigid3.identity(2), np.eye(3))


def test_skew_rays_meet_in_the_middle_of_their_gap() -> None:
    # Along z through the origin, and along x at height y = 1, z = 5, seen from the center (1, 0, 0).
    points, along1, along2 = triangulate_two_view(SIDEWAYS, [[0.0, 0, 2]], [[-1.0, 1.0, 5.0]])
    gap = np.array([[1.0, 0, 0]]) + along2[:, None] * np.array([[-1.0, 1.0, 5.0]]) / np.sqrt(27)
    on_first = along1[:, None] * np.array([[0.0, 0, 1]])
    np.testing.assert_allclose(points, (gap + on_first) / 2)
    # The shortest segment is at right angles to both rays.
    np.testing.assert_allclose((gap - on_first) @ np.array([[0.0, -1.0], [0, 1], [1, 5]]), 0, atol=1e-14)


def test_depths_are_negative_behind() -> None:
    _, along1, along2 = triangulate_two_view(SIDEWAYS, [[0.0, 0, -1], [0, 0, 1]], [[-0.5, 0, 1], [0.5, 0, 1]])
    assert along1[0] < 0 < along2[0] and along1[1] < 0 and along2[1] < 0


def test_parallel_and_nan_rays_give_nan_alone() -> None:
    rays1 = np.array([[0.0, 0, 1], [1, 2, 3], [np.nan, 0, 1], [0, 0, 0], [0, 0, 1]])
    rays2 = np.array([[0.0, 0, 1], [2, 4, 6], [0, 0, 1], [0, 0, 1], [-1, 0, 1]])
    with np.errstate(all="raise"):
        points, along1, along2 = triangulate_two_view(SIDEWAYS, rays1, rays2)
    assert np.isnan(points[:4]).all() and np.isnan(along1[:4]).all() and np.isnan(along2[:4]).all()
    np.testing.assert_allclose(points[4], [0, 0, 1])


def test_parallel_rays_give_nan_in_spite_of_rounding(rng: np.random.Generator) -> None:
    motion = Rigid3.exp([1.0, 0.0, 0.0, 0.3, -0.7, 0.2])
    rays = rng.normal(size=(500, 3))
    points, _, _ = triangulate_two_view(motion, rays, rays @ motion.rotation.T)
    assert np.isnan(points).all()


def test_no_baseline_puts_nothing_in_front() -> None:
    points, along1, along2 = triangulate_two_view(Rigid3.identity(), [[0.0, 0, 1]], [[0.1, 0, 1]])
    np.testing.assert_array_equal(points, [[0.0, 0, 0]])
    assert along1[0] == along2[0] == 0.0


def test_no_ray_and_one_ray() -> None:
    for count in (0, 1):
        rays1, rays2 = np.tile([0.0, 0, 1], (count, 1)), np.tile([-1.0, 0, 1], (count, 1))
        points, along1, along2 = triangulate_two_view(SIDEWAYS, rays1, rays2)
        assert points.shape == (count, 3) and along1.shape == along2.shape == (count,)


def test_two_views_check_their_arguments() -> None:
    with pytest.raises(ShapeError, match="rays1 has 2, rays2 has 3"):
        triangulate_two_view(SIDEWAYS, np.ones((2, 3)), np.ones((3, 3)))
    with pytest.raises(ShapeError, match="rays2 must be"):
        triangulate_two_view(SIDEWAYS, np.ones((2, 3)), np.ones((2, 2)))


def test_angles_at_a_point() -> None:
    assert float(ray_angles_rad([0.0, 0, 1], [-1.0, 0, 0], [1.0, 0, 0])) == pytest.approx(np.pi / 2)
    angles = ray_angles_rad([[0.0, 0, 1e6], [0, 0, 0], [2, 0, 0]], [-0.5, 0, 0], [[0.5, 0, 0]] * 3)
    np.testing.assert_allclose(angles, [1e-6, np.pi, 0.0], rtol=1e-9, atol=1e-12)
    assert np.isnan(ray_angles_rad([np.nan, 0, 0], [1.0, 0, 0], [0.0, 1, 0]))
