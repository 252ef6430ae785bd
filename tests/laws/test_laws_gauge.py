"""Gauge freedom: a similarity of the world, its cameras and its points changes no pixel."""

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3, Similarity3, align_points

CAMERA = Camera(CameraModel.OPENCV, 640, 480, np.array([500.0, 490.0, 320.0, 240.0, -0.1, 0.02, 1e-3, -1e-3]))


def random_similarity(rng: np.random.Generator, *batch: int) -> Similarity3:
    return Similarity3.exp(rng.normal(size=(*batch, 7)))


@pytest.fixture
def cams_from_source(rng: np.random.Generator) -> Rigid3:
    rotations = Rigid3.exp(np.column_stack([rng.normal(size=(8, 3)), 0.2 * rng.normal(size=(8, 3))]))
    return Rigid3(np.eye(3)[None], np.array([[0.0, 0.0, 6.0]])) @ rotations


def test_moved_cameras_see_moved_points_at_the_same_pixels(
    cams_from_source: Rigid3, rng: np.random.Generator
) -> None:
    points = rng.uniform(-1, 1, (30, 3))
    for _ in range(5):
        target_from_source = random_similarity(rng)
        cams_from_target = target_from_source.move_cam_from_source(cams_from_source)
        moved = target_from_source.apply(points)
        for cam in range(8):
            before = CAMERA.project(cams_from_source[cam].apply(points))
            assert np.isfinite(before).all()
            np.testing.assert_allclose(CAMERA.project(cams_from_target[cam].apply(moved)), before, atol=1e-9)
        centers = target_from_source.apply(cams_from_source.centers())
        np.testing.assert_allclose(cams_from_target.centers(), centers, rtol=1e-10, atol=1e-10)
        determinants = np.linalg.det(cams_from_target.rotation)
        np.testing.assert_allclose(determinants, 1.0)


def test_moving_there_and_back_changes_nothing(cams_from_source: Rigid3, rng: np.random.Generator) -> None:
    similarity = random_similarity(rng)
    back = similarity.inverse().move_cam_from_source(similarity.move_cam_from_source(cams_from_source))
    np.testing.assert_allclose(back.as_matrix(), cams_from_source.as_matrix(), atol=1e-12)


def test_moving_is_an_action(cams_from_source: Rigid3, rng: np.random.Generator) -> None:
    a, b = random_similarity(rng), random_similarity(rng)
    at_once = (a @ b).move_cam_from_source(cams_from_source)
    in_steps = a.move_cam_from_source(b.move_cam_from_source(cams_from_source))
    np.testing.assert_allclose(at_once.as_matrix(), in_steps.as_matrix(), atol=1e-11)


def test_one_similarity_for_each_camera(cams_from_source: Rigid3, rng: np.random.Generator) -> None:
    many = random_similarity(rng, 8)
    moved = many.move_cam_from_source(cams_from_source)
    for cam in range(8):
        alone = many[cam].move_cam_from_source(cams_from_source[cam])
        np.testing.assert_allclose(moved[cam].as_matrix(), alone.as_matrix(), atol=1e-13)


def test_alignment_of_moved_points_is_the_move(rng: np.random.Generator) -> None:
    for _ in range(20):
        similarity = random_similarity(rng)
        points = rng.normal(size=(int(rng.integers(3, 40)), 3)) * rng.uniform(0.1, 100)
        found = align_points(points, similarity.apply(points))
        np.testing.assert_allclose(found.scale, similarity.scale, rtol=1e-11)
        np.testing.assert_allclose(found.rotation, similarity.rotation, atol=1e-10)
        np.testing.assert_allclose(found.apply(points), similarity.apply(points), rtol=1e-9, atol=1e-9)


def test_alignment_follows_a_change_of_either_coordinates(rng: np.random.Generator) -> None:
    source = rng.normal(size=(15, 3))
    target = random_similarity(rng).apply(source) + 0.05 * rng.normal(size=(15, 3))
    a, b = random_similarity(rng), random_similarity(rng)
    direct, moved = align_points(source, target), align_points(a.apply(source), b.apply(target))
    np.testing.assert_allclose((b @ direct @ a.inverse()).log(), moved.log(), atol=1e-10)
