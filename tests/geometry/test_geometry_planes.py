"""Homographies of planes: decomposition against known motions; rectification against known matches."""

import numpy as np
import pytest

from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry import (
    Rigid3,
    Rotation3,
    decompose_homography,
    essential_from_cam2_from_cam1,
    from_homogeneous,
    fundamental_from_essential,
    rectifying_homographies,
    to_homogeneous,
)

K = np.array([[800.0, 0, 640], [0, 790, 480], [0, 0, 1]])


@pytest.mark.parametrize("scale", [1.0, -3.0, 1e-4])
def test_decomposition_of_a_homography_contains_the_truth(rng, scale):
    for _ in range(50):
        motion = Rigid3.exp(np.concatenate([rng.normal(size=3), 0.3 * rng.normal(size=3)]))
        normal = np.array([0.0, 0.0, 1.0]) + 0.4 * rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        distance = rng.uniform(3, 6)
        H = scale * K @ (motion.rotation + np.outer(motion.translation, normal) / distance) @ np.linalg.inv(K)
        found = decompose_homography(H, K, K)
        error = (
            np.abs(found.cam2_from_cam1.rotation - motion.rotation).max(axis=(1, 2))
            + np.abs(found.cam2_from_cam1.translation - motion.translation / distance).max(axis=1)
            + np.abs(found.normals_in_cam1 - normal).max(axis=1)
        )
        assert len(found) == 4 and error.min() < 1e-9
        for k in range(4):
            again = found.cam2_from_cam1.rotation[k] + np.outer(
                found.cam2_from_cam1.translation[k], found.normals_in_cam1[k]
            )
            again = K @ again @ np.linalg.inv(K)
            np.testing.assert_allclose(again / again[2, 2], H / H[2, 2], rtol=1e-7, atol=1e-9)


def test_points_on_the_plane_leave_at_most_two_solutions(rng):
    motion, normal = Rigid3.exp(np.array([0.5, 0.1, 0.2, 0.05, 0.1, 0.0])), np.array([0.0, 0.2, 0.98])
    normal /= np.linalg.norm(normal)
    H = K @ (motion.rotation + np.outer(motion.translation, normal) / 4) @ np.linalg.inv(K)
    found = decompose_homography(H, K, K, rng.uniform(0, 900, (30, 2)))
    assert 1 <= len(found) <= 2
    assert np.abs(found.normals_in_cam1 - normal).max(axis=1).min() < 1e-9


def test_a_rotation_has_no_plane():
    R = Rotation3.exp(np.array([0.1, -0.2, 0.3])).matrix
    found = decompose_homography(K @ R @ np.linalg.inv(K), K, K)
    assert len(found) == 1 and np.isnan(found.normals_in_cam1).all()
    np.testing.assert_allclose(found.cam2_from_cam1.rotation[0], R, atol=1e-12)
    np.testing.assert_array_equal(found.cam2_from_cam1.translation, 0)


def test_a_singular_homography_is_refused():
    with pytest.raises(DegenerateGeometryError):
        decompose_homography(np.diag([1.0, 1.0, 0.0]), np.eye(3), np.eye(3))
    with pytest.raises(ShapeError):
        decompose_homography(np.full((3, 3), np.nan), K, K)


def two_views(rng, motion):
    points = rng.uniform([-2, -1.5, 4], [2, 1.5, 8], (60, 3))
    x1, x2 = from_homogeneous(points @ K.T), from_homogeneous(motion.apply(points) @ K.T)
    return x1, x2, fundamental_from_essential(essential_from_cam2_from_cam1(motion), K, K)


def test_rectified_matches_lie_in_the_same_row(rng):
    for _ in range(20):
        translation = np.array([-1.0, 0.2, 0.1]) + 0.1 * rng.normal(size=3)
        motion = Rigid3(Rotation3.exp(0.1 * rng.normal(size=3)).matrix, translation)
        x1, x2, F = two_views(rng, motion)
        H1, H2 = rectifying_homographies(F, x1, x2, (1280, 960))
        r1 = from_homogeneous(to_homogeneous(x1) @ H1.T)
        r2 = from_homogeneous(to_homogeneous(x2) @ H2.T)
        np.testing.assert_allclose(r1[:, 1], r2[:, 1], atol=1e-6)
        # The center of image 2 stays and is not stretched.
        center = np.array([[639.5, 479.5], [640.5, 479.5], [639.5, 480.5]])
        moved = from_homogeneous(to_homogeneous(center) @ H2.T)
        np.testing.assert_allclose(moved[0], center[0], atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(moved[1:] - moved[0], axis=1), 1.0, atol=2e-3)


def test_a_forward_motion_cannot_be_rectified(rng):
    x1, x2, F = two_views(rng, Rigid3(np.eye(3), np.array([0.0, 0.0, -1.0])))
    with pytest.raises(DegenerateGeometryError, match="epipole"):
        rectifying_homographies(F, x1, x2, (1280, 960))
