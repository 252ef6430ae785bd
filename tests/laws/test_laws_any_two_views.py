"""Epipolar geometry, homographies and triangulation for motions and points that Hypothesis makes up."""

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from any_geometry import calibration_matrices, numbers, points_ahead, steps_aside, twists, vectors
from epipole.geometry import (
    Rigid3,
    decompose_homography,
    essential_from_cam2_from_cam1,
    essential_from_fundamental,
    from_homogeneous,
    fundamental_from_essential,
    sampson_error,
    to_homogeneous,
    triangulate_linear,
)

K = calibration_matrices()


def pixels_of(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return from_homogeneous(points @ matrix.T)


@given(steps_aside(), points_ahead(), K, K)
def test_matching_pixels_meet_the_fundamental_matrix(motion, points, K1, K2) -> None:
    """x2^T F x1 = 0, rank two, and E comes back."""
    essential = essential_from_cam2_from_cam1(motion)
    F = fundamental_from_essential(essential, K1, K2)
    x1 = to_homogeneous(pixels_of(K1, points))
    x2 = to_homogeneous(pixels_of(K2, motion.apply(points)))
    residual = np.einsum("ni,ij,nj->n", x2, F, x1)
    size = np.einsum("ni,ij,nj->n", np.abs(x2), np.abs(F), np.abs(x1))
    assert (np.abs(residual) <= 1e-12 * size).all()
    # At both epipoles the formula is 0 / 0.
    assert not (sampson_error(F, x1[:, :2], x2[:, :2]) > 1e-8).any()
    balanced = np.diag([1000.0, 1000.0, 1.0])  # pixels in thousands, so that no entry drowns the others
    singular = np.linalg.svd(balanced @ F @ balanced, compute_uv=False)
    assert singular[2] <= 1e-13 * singular[0] and singular[1] > 1e-4 * singular[0]
    np.testing.assert_allclose(essential_from_fundamental(F, K1, K2), essential, atol=1e-10)


@given(st.lists(twists(), min_size=3, max_size=6), vectors(3, 5.0))
def test_a_point_seen_from_many_places_is_found(xis: list[np.ndarray], point: np.ndarray) -> None:
    """Whatever the cameras' turns, and on whichever side of them: rays have directions, not pixels."""
    cams_from_world = Rigid3.exp(np.array(xis))
    offsets = cams_from_world.centers() - point
    assume((np.linalg.norm(offsets, axis=1) > 0.1).all())
    directions = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    assume(np.linalg.svd(directions, compute_uv=False)[1] > 0.2)
    rays = cams_from_world.apply(np.broadcast_to(point, (len(xis), 3)).copy())
    np.testing.assert_allclose(triangulate_linear(cams_from_world, rays), point, atol=1e-7)


@st.composite
def planes(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """A normal n and 12 points with n . X = 1 ahead of camera 1."""
    depth, slope = draw(numbers(4, 9)), draw(vectors(2, 0.5))
    x, y = np.meshgrid(np.linspace(-1, 1, 4), np.linspace(-1, 1, 3))
    normal = np.array([-slope[0], -slope[1], 1.0]) / depth
    z = depth + slope[0] * x + slope[1] * y
    return normal, np.stack([x, y, z], axis=-1).reshape(-1, 3)


@given(steps_aside(), planes(), K, K)
def test_a_plane_gives_a_homography_whose_motions_hold_the_truth(motion, plane, K1, K2) -> None:
    """x2 ~ K2 (R + t n^T) K1^-1 x1 on the plane n . X = 1; decomposed, and put together again."""
    normal, points = plane
    H = K2 @ (motion.rotation + np.outer(motion.translation, normal)) @ np.linalg.inv(K1)
    in_cam2 = motion.apply(points)
    center_side = 1.0 + normal @ motion.rotation.T @ motion.translation
    assume((in_cam2[:, 2] > 1).all() and center_side > 0.2)
    pixels1 = pixels_of(K1, points)
    mapped = from_homogeneous(to_homogeneous(pixels1) @ H.T)
    np.testing.assert_allclose(mapped, pixels_of(K2, in_cam2), atol=1e-8)
    found = decompose_homography(3.0 * H, K1, K2, pixels1)
    assert 1 <= len(found) <= 2
    distance = 1.0 / np.linalg.norm(normal)
    errors = [
        max(
            np.abs(found.cam2_from_cam1[k].rotation - motion.rotation).max(),
            np.abs(found.cam2_from_cam1[k].translation - motion.translation / distance).max(),
            np.abs(found.normals_in_cam1[k] - normal * distance).max(),
        )
        for k in range(len(found))
    ]
    assert min(errors) < 1e-6
