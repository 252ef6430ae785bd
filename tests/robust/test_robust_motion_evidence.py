"""Relative poses at the noise of their matches: sign, degeneracy, rivals, uncertainty."""

import numpy as np
import pytest
from scipy.stats import chi2

from epipole.cameras import Camera
from epipole.config import RansacConfig
from epipole.geometry import Rigid3, Rotation3
from epipole.robust import estimate_fundamental_matrix, estimate_homography, estimate_relative_pose
from epipole.robust.estimate import Reason
from epipole.robust.pairs.motion_evidence import lie_on_a_line
from epipole.robust.ray_matches import Matches, moved_motion
from whole import IS_WHOLE

CAMERA = Camera("PINHOLE", 1280, 960, [800.0, 800.0, 639.5, 479.5])
FISHEYE = Camera("OPENCV_FISHEYE", 1280, 960, [400.0, 400.0, 639.5, 479.5, 0.01, 0.0, 0.0, 0.0])
MIDDLE = np.array([639.5, 479.5])


def matches_of(
    seed: int,
    *,
    count: int = 200,
    baseline: float = 0.6,
    wrong: float = 0.0,
    noise_px: float = 0.5,
    depths: tuple[float, float] = (4.0, 9.0),
) -> tuple[np.ndarray, np.ndarray, Rigid3]:
    """Pixels of both images, some of them wrong, and cam2_from_cam1."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    rotation = Rotation3.exp(0.05 * rng.normal(size=3)).matrix
    translation = -baseline * rotation @ direction
    first = np.empty((0, 2))
    second = np.empty((0, 2))
    while len(first) < count:
        pixels = rng.uniform([0, 0], [1280, 960], (4 * count, 2))
        depth = np.exp(rng.uniform(*np.log(depths), 4 * count))
        points = np.column_stack([(pixels - MIDDLE) / 800.0, np.ones(4 * count)]) * depth[:, None]
        moved = points @ rotation.T + translation
        seen = 800.0 * moved[:, :2] / moved[:, 2:] + MIDDLE
        inside = (moved[:, 2] > 0.1) & (seen > 0).all(axis=1) & (seen < [1280, 960]).all(axis=1)
        first, second = np.concatenate([first, pixels[inside]]), np.concatenate([second, seen[inside]])
    first = first[:count] + noise_px * rng.normal(size=(count, 2))
    second = second[:count] + noise_px * rng.normal(size=(count, 2))
    num_wrong = int(wrong * count)
    second[:num_wrong] = rng.uniform([0, 0], [1280, 960], (num_wrong, 2))
    size = np.linalg.norm(translation)
    return first, second, Rigid3(rotation, translation / size if size > 0 else translation)


def line_matches(seed: int, noise_px: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    motion = Rigid3(Rotation3.exp(0.05 * rng.normal(size=3)).matrix, rng.normal(size=3) * [1.0, 1.0, 0.2])
    points = np.array([0.0, 0.0, 6.0]) + rng.uniform(-1, 1, (100, 1)) * [2.5, 1.0, 0.8]
    return tuple(
        CAMERA.project(p) + noise_px * rng.normal(size=(100, 2)) for p in (points, motion.apply(points))
    )


def angle_deg(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.rad2deg(np.arccos(np.clip(found @ truth, -1.0, 1.0))))


@pytest.mark.parametrize("noise_px", [0.3] + IS_WHOLE * [0.1])
def test_far_points_give_the_sign_of_the_translation_or_say_that_they_cannot(noise_px: float) -> None:
    """Parallax of one to four pixels: without a vote at the noise, one sign in ten was wrong."""
    for seed in range(10):
        first, second, truth = matches_of(seed, baseline=1.0, noise_px=noise_px, depths=(200.0, 1000.0))
        found = estimate_relative_pose(first, second, CAMERA, CAMERA, RansacConfig(seed=seed))
        assert not found.success or angle_deg(found.model.translation, truth.translation) < 20.0


def test_points_at_infinity_have_no_sign_and_no_translation() -> None:
    for seed in range(6):
        first, second, _ = matches_of(seed, baseline=0.003, depths=(8.0, 9.0))
        found = estimate_relative_pose(first, second, CAMERA, CAMERA, RansacConfig(seed=seed))
        assert found.reason in (Reason.UNKNOWN_SIGN, Reason.DEGENERATE)
        assert np.isinf(found.covariance).all()


@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_a_noisy_rotation_is_degenerate(wrong: float) -> None:
    for seed in range(8):
        first, second, _ = matches_of(seed, baseline=0.0, wrong=wrong)
        assert not estimate_relative_pose(first, second, CAMERA, CAMERA, RansacConfig(seed=seed)).success


@pytest.mark.parametrize("noise_px", [0.1, 0.5])
def test_noisy_points_on_a_line_are_degenerate(noise_px: float) -> None:
    for seed in range(5):
        first, second = line_matches(seed, noise_px)
        config = RansacConfig(seed=seed)
        assert not estimate_relative_pose(first, second, CAMERA, CAMERA, config).success
        assert not estimate_homography(first, second, config).success
        assert not estimate_fundamental_matrix(first, second, config).success


def test_a_line_is_judged_by_its_noise() -> None:
    rng = np.random.default_rng(0)
    along = rng.uniform(0, 1000, 100)
    across = rng.normal(0, 0.5, 100)
    pixels = np.column_stack([along + across, 0.5 * along - across])
    assert lie_on_a_line(pixels, 0.5)
    assert not lie_on_a_line(pixels + 20.0 * rng.normal(size=(100, 2)), 0.5)


@pytest.mark.parametrize(
    ("case", "bounds"),
    [({"wrong": 0.3}, (0.40, 0.80))] + IS_WHOLE * [({}, (0.45, 0.85)), ({"baseline": 0.05}, (0.40, 0.85))],
    ids=["a third wrong"] + IS_WHOLE * ["clean", "little parallax"],
)
def test_regions_hold_the_truth_as_often_as_they_say(case: dict, bounds: tuple[float, float]) -> None:
    """The 68.3 % region, in 24 trials: two binomial deviations are 0.19."""
    inside, trials = 0, 24
    for seed in range(trials):
        first, second, truth = matches_of(seed, **case)
        found = estimate_relative_pose(first, second, CAMERA, CAMERA, RansacConfig(seed=seed))
        assert found.success
        xi = (found.model @ truth.inverse()).log()
        values, vectors = np.linalg.eigh(found.covariance)
        along = (vectors.T @ xi)[1:]  # rank five: the length of t is free
        inside += float((along**2 / values[1:]).sum()) < chi2.ppf(0.683, 5)
    assert bounds[0] <= inside / trials <= bounds[1]


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=["pinhole", "fisheye"])
def test_residuals_and_derivatives_are_those_of_the_pixels(camera: Camera) -> None:
    """Small errors e of the pixels give residuals near their length across the epipolar line; J agrees with differences."""
    rng = np.random.default_rng(0)
    motion = Rigid3(Rotation3.exp([0.02, -0.05, 0.03]).matrix, np.array([0.6, 0.0, 0.8]))
    points = rng.uniform([-3, -2, 4], [3, 2, 9], (50, 3))
    first, second = camera.project(points), camera.project(motion.apply(points))
    exact = Matches(first, second, camera, camera)
    np.testing.assert_allclose(exact.sampson(motion.rotation, motion.translation), 0.0, atol=1e-9)
    noisy = Matches(first, second + 0.01 * rng.normal(size=(50, 2)), camera, camera)
    residual = noisy.sampson(motion.rotation, motion.translation)
    assert 0.004 < residual.std() < 0.011  # 0.01 shared by two images: 0.007
    jacobian = noisy.jacobian(motion.rotation, motion.translation)
    for k, step in enumerate(1e-6 * np.eye(5)):
        up, down = (
            noisy.sampson(*moved_motion(s * step, motion.rotation, motion.translation)) for s in (1, -1)
        )
        np.testing.assert_allclose(jacobian[:, k], (up - down) / 2e-6, atol=0.05)
    shift, _ = exact.parallax(motion.rotation, motion.translation)
    assert (shift > 0).all()


def test_few_points_are_enough_for_a_pose_and_a_homography() -> None:
    """What is needed by default depends on what chance gives: twelve points never sufficed when 15 were always asked for."""
    from epipole.robust import estimate_absolute_pose
    from epipole.synthetic.problems import absolute_pose_problem

    problem = absolute_pose_problem(12, noise_px=0.5, seed=1)
    found = estimate_absolute_pose(problem.points_in_world, problem.pixels, problem.camera)
    assert found.success and found.num_inliers >= 10
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, 1000, (10, 2))
    assert estimate_homography(pixels, 1.1 * pixels + [5.0, -3.0]).success
    assert (
        RansacConfig().needed_inliers(5, 1) == 15 and RansacConfig(min_inliers=20).needed_inliers(3, 2) == 20
    )
