"""Laws of two-view geometry, over random scenes with known motion."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from epipole.geometry import (
    Rigid3,
    choose_by_cheirality,
    decompose_essential_matrix,
    epipolar_lines,
    epipoles,
    essential_from_cam2_from_cam1,
    essential_from_fundamental,
    from_homogeneous,
    fundamental_from_essential,
    point_line_distance,
    sampson_error,
    to_homogeneous,
    triangulate_two_view,
)

K1 = np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
K2 = np.array([[700.0, 0.0, 400.0], [0.0, 690.0, 300.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Scene:
    """Points before two cameras, and what each sees of them."""

    cam2_from_cam1: Rigid3
    points: np.ndarray
    rays1: np.ndarray
    rays2: np.ndarray

    @property
    def essential(self) -> np.ndarray:
        return essential_from_cam2_from_cam1(self.cam2_from_cam1)

    @property
    def fundamental(self) -> np.ndarray:
        return fundamental_from_essential(self.essential, K1, K2)

    @property
    def pixels1(self) -> np.ndarray:
        return from_homogeneous(self.rays1 @ K1.T)

    @property
    def pixels2(self) -> np.ndarray:
        return from_homogeneous(self.rays2 @ K2.T)


@pytest.fixture(params=range(16))
def scene(request: pytest.FixtureRequest) -> Scene:
    rng = np.random.default_rng(request.param)
    motion = Rigid3.exp(np.concatenate([rng.normal(size=3), 0.3 * rng.normal(size=3)]))
    points = rng.uniform([-2, -2, 5], [2, 2, 9], (40, 3))
    in_cam2 = motion.apply(points)
    assert (in_cam2[:, 2] > 0.5).all()
    # Rays of any length must do.
    return Scene(motion, points, points * rng.uniform(0.1, 3, (40, 1)), in_cam2 / in_cam2[:, 2:])


def same_up_to_sign(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    return np.minimum(np.abs(a - b).max(), np.abs(a + b).max())


def test_matching_rays_meet_the_constraint(scene: Scene) -> None:
    residual = np.einsum("ni,ij,nj->n", scene.rays2, scene.essential, scene.rays1)
    size = np.linalg.norm(scene.rays1, axis=1) * np.linalg.norm(scene.rays2, axis=1)
    assert np.abs(residual / size).max() < 1e-14


def test_constraint_is_the_volume_of_ray_ray_baseline(scene: Scene, rng: np.random.Generator) -> None:
    any1, any2 = rng.normal(size=(2, 9, 3))
    motion = scene.cam2_from_cam1
    volume = [np.linalg.det([b, motion.translation, motion.rotation @ a]) for a, b in zip(any1, any2)]
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", any2, scene.essential, any1), volume, atol=1e-12)


def test_essential_has_two_equal_singular_values(scene: Scene) -> None:
    singular = np.linalg.svd(scene.essential, compute_uv=False)
    length = np.linalg.norm(scene.cam2_from_cam1.translation)
    np.testing.assert_allclose(singular, [length, length, 0.0], atol=1e-14)


@pytest.mark.parametrize("factor", [1e-6, 3.0, -2.0])
def test_essential_scales_with_the_baseline(scene: Scene, factor: float) -> None:
    motion = scene.cam2_from_cam1
    longer = essential_from_cam2_from_cam1(Rigid3(motion.rotation, factor * motion.translation))
    np.testing.assert_allclose(longer, factor * scene.essential, rtol=1e-12)


def test_exchanging_the_cameras_transposes(scene: Scene) -> None:
    back = essential_from_cam2_from_cam1(scene.cam2_from_cam1.inverse())
    np.testing.assert_allclose(back, scene.essential.T, atol=1e-13)


def test_matching_pixels_meet_the_constraint(scene: Scene) -> None:
    x1, x2 = to_homogeneous(scene.pixels1), to_homogeneous(scene.pixels2)
    scale = np.abs(x2) @ np.abs(scene.fundamental) @ np.abs(x1).T
    assert (np.abs(np.einsum("ni,ij,nj->n", x2, scene.fundamental, x1)) < 1e-12 * np.diag(scale)).all()


def test_fundamental_and_essential_round_trip(scene: Scene) -> None:
    np.testing.assert_allclose(
        scene.fundamental, np.linalg.inv(K2).T @ scene.essential @ np.linalg.inv(K1), rtol=1e-12, atol=1e-18
    )
    back = essential_from_fundamental(scene.fundamental, K1, K2)
    np.testing.assert_allclose(back, scene.essential, atol=1e-12)


def test_lines_go_through_the_matches(scene: Scene) -> None:
    lines2 = epipolar_lines(scene.fundamental, scene.pixels1)
    lines1 = epipolar_lines(scene.fundamental.T, scene.pixels2)
    np.testing.assert_allclose(np.linalg.norm(lines2[:, :2], axis=1), 1.0, atol=1e-14)
    assert point_line_distance(scene.pixels2, lines2).max() < 1e-9
    assert point_line_distance(scene.pixels1, lines1).max() < 1e-9
    theirs = cv2.computeCorrespondEpilines(scene.pixels1[:, None], 1, scene.fundamental)[:, 0]
    sign = np.sign((theirs[:, :2] * lines2[:, :2]).sum(axis=1))[:, None]
    np.testing.assert_allclose(sign * lines2, theirs, rtol=1e-8, atol=1e-10)


def test_epipoles_lie_on_all_lines_and_are_the_other_center(scene: Scene) -> None:
    epipole1, epipole2 = epipoles(scene.fundamental)
    motion = scene.cam2_from_cam1
    assert same_up_to_sign(epipole1, K1 @ motion.inverse().translation) < 1e-10
    assert same_up_to_sign(epipole2, K2 @ motion.translation) < 1e-10
    lines2 = epipolar_lines(scene.fundamental, scene.pixels1)
    lines1 = epipolar_lines(scene.fundamental.T, scene.pixels2)
    assert np.abs(lines2 @ epipole2).max() < 1e-9 and np.abs(lines1 @ epipole1).max() < 1e-9


def test_four_candidates_hold_the_truth_and_cheirality_chooses_it(scene: Scene) -> None:
    motion = scene.cam2_from_cam1
    length = np.linalg.norm(motion.translation)
    candidates = decompose_essential_matrix(scene.essential)
    assert len(candidates) == 4
    np.testing.assert_allclose(np.linalg.det(candidates.rotation), 1.0)
    np.testing.assert_allclose(np.linalg.norm(candidates.translation, axis=1), 1.0)
    for index in range(4):  # each gives the same E up to scale
        assert same_up_to_sign(essential_from_cam2_from_cam1(candidates[index]), scene.essential) < 1e-12
    index, in_front, points = choose_by_cheirality(candidates, scene.rays1, scene.rays2)
    np.testing.assert_allclose(candidates[index].rotation, motion.rotation, atol=1e-12)
    np.testing.assert_allclose(candidates[index].translation, motion.translation / length, atol=1e-12)
    assert in_front.all()
    np.testing.assert_allclose(points * length, scene.points, rtol=1e-9)


@pytest.mark.parametrize("factor", [-1.0, 1e-8, -1e5])
def test_decomposition_does_not_depend_on_the_scale_of_e(scene: Scene, factor: float) -> None:
    index, in_front, _ = choose_by_cheirality(
        (candidates := decompose_essential_matrix(factor * scene.essential)), scene.rays1, scene.rays2
    )
    np.testing.assert_allclose(candidates[index].rotation, scene.cam2_from_cam1.rotation, atol=1e-12)
    assert in_front.all()


def test_cheirality_chooses_with_a_quarter_of_wrong_matches(scene: Scene, rng: np.random.Generator) -> None:
    rays2 = scene.rays2.copy()
    rays2[:10] = rng.normal(size=(10, 3))
    candidates = decompose_essential_matrix(scene.essential)
    index, in_front, _ = choose_by_cheirality(candidates, scene.rays1, rays2)
    np.testing.assert_allclose(candidates[index].rotation, scene.cam2_from_cam1.rotation, atol=1e-12)
    assert in_front[10:].all()


def test_sampson_error_equals_the_formula(scene: Scene, rng: np.random.Generator) -> None:
    F, pixels1 = scene.fundamental, scene.pixels1 + rng.normal(size=(40, 2))
    pixels2 = scene.pixels2 + rng.normal(size=(40, 2))
    expected = []
    for (u1, v1), (u2, v2) in zip(pixels1, pixels2):
        x1, x2 = np.array([u1, v1, 1.0]), np.array([u2, v2, 1.0])
        a, b = F @ x1, F.T @ x2
        expected.append(abs(x2 @ a) / np.sqrt(a[0] ** 2 + a[1] ** 2 + b[0] ** 2 + b[1] ** 2))
    found = sampson_error(F, pixels1, pixels2)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(sampson_error(-7.0 * F, pixels1, pixels2), found, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(sampson_error(F.T, pixels2, pixels1), found, rtol=1e-9, atol=1e-11)
    squared = [
        cv2.sampsonDistance(np.array([*a, 1.0]), np.array([*b, 1.0]), F) for a, b in zip(pixels1, pixels2)
    ]
    np.testing.assert_allclose(found, np.sqrt(squared), rtol=1e-8, atol=1e-10)


def test_sampson_error_is_the_distance_for_small_noise(scene: Scene, rng: np.random.Generator) -> None:
    """Moving a match along the gradient of its constraint by d pixels gives an error of d."""
    F, x1, x2 = scene.fundamental, to_homogeneous(scene.pixels1), to_homogeneous(scene.pixels2)
    gradient = np.concatenate([(x2 @ F)[:, :2], (x1 @ F.T)[:, :2]], axis=1)
    step = 1e-3 * gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    found = sampson_error(F, scene.pixels1 + step[:, :2], scene.pixels2 + step[:, 2:])
    np.testing.assert_allclose(found, 1e-3, rtol=1e-4)


def test_triangulation_of_exact_rays_is_exact(scene: Scene) -> None:
    points, depth1, depth2 = triangulate_two_view(scene.cam2_from_cam1, scene.rays1, scene.rays2)
    np.testing.assert_allclose(points, scene.points, rtol=1e-10)
    np.testing.assert_allclose(depth1, np.linalg.norm(scene.points, axis=1), rtol=1e-10)
    in_cam2 = scene.cam2_from_cam1.apply(scene.points)
    np.testing.assert_allclose(depth2, np.linalg.norm(in_cam2, axis=1), rtol=1e-10)


@pytest.mark.parametrize("baseline", [1e-3, 1e-5, 1e-7])
def test_triangulation_keeps_its_digits_at_narrow_angles(scene: Scene, baseline: float) -> None:
    """The angle is known to about 1e-16, so that depth is known to about 1e-16 over the angle."""
    motion = Rigid3(scene.cam2_from_cam1.rotation, baseline * scene.cam2_from_cam1.translation)
    points, _, _ = triangulate_two_view(motion, scene.points, motion.apply(scene.points))
    angle = baseline * np.linalg.norm(scene.cam2_from_cam1.translation) / 7
    error = np.linalg.norm(points - scene.points, axis=1) / np.linalg.norm(scene.points, axis=1)
    assert np.median(error) < 1e-15 / angle + 1e-14
