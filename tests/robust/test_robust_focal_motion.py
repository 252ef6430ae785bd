"""Relative pose with unknown focal lengths: exact samples contain the truth; noise and outliers leave it near."""

import numpy as np
import pytest
from scipy.stats import chi2

from epipole.config import RansacConfig
from epipole.geometry import Rigid3, Rotation3, essential_from_cam2_from_cam1
from epipole.robust import Reason, estimate_motion_and_focals, estimate_motion_and_shared_focal
from epipole.solvers import solve_shared_focal_six_point
from epipole.solvers._focal_motion_kernels import (
    focals_from_fundamental,
    shared_focal_six_point,
    shared_focal_workspace,
)
from epipole.synthetic.problems import two_view_problem
from whole import IS_WHOLE

CENTER = (639.5, 479.5)


def random_views(rng, count):
    motion = Rigid3(Rotation3.exp(0.3 * rng.normal(size=3)).matrix, rng.normal(size=3))
    points = rng.uniform([-2, -1.5, 4], [2, 1.5, 9], (count, 3))
    return motion, points / points[:, 2:], (m := motion.apply(points)) / m[:, 2:]


def test_six_exact_matches_contain_the_shared_focal_length(rng):
    workspace, essentials, focals = shared_focal_workspace(), np.empty((8, 9)), np.empty(8)
    missed = 0
    for _ in range(150):
        motion, y1, y2 = random_views(rng, 6)
        focal = rng.uniform(0.4, 5.0)
        scale = np.array([focal, focal, 1.0])
        count = shared_focal_six_point(y1 * scale, y2 * scale, essentials, focals, workspace)
        truth = essential_from_cam2_from_cam1(motion)
        truth /= np.linalg.norm(truth)
        error = [
            abs(focals[k] / focal - 1) + 1 - abs((essentials[k].reshape(3, 3) * truth).sum())
            for k in range(count)
        ]
        missed += not min(error, default=1.0) < 1e-6
    assert missed <= 1, missed


def test_the_six_point_solver_works_in_pixels(rng):
    motion, y1, y2 = random_views(rng, 6)
    found = solve_shared_focal_six_point(700.0 * y1[:, :2], 700.0 * y2[:, :2])
    camera = np.diag([1.0, 1.0, 700.0])
    truth = camera @ essential_from_cam2_from_cam1(motion) @ camera
    nearest = np.argmin(np.abs(found.focal_px - 700.0))
    assert found.focal_px[nearest] == pytest.approx(700.0, rel=1e-5)
    alike = abs((found.fundamental[nearest] * truth).sum()) / np.linalg.norm(truth)
    assert alike == pytest.approx(1.0, abs=1e-9)


def test_focal_lengths_of_an_exact_fundamental_matrix(rng):
    for _ in range(100):
        motion, _, _ = random_views(rng, 1)
        f1, f2 = rng.uniform(0.5, 4.0, 2)
        F = (
            np.diag([1 / f2, 1 / f2, 1])
            @ essential_from_cam2_from_cam1(motion)
            @ np.diag([1 / f1, 1 / f1, 1])
        )
        np.testing.assert_allclose(focals_from_fundamental(F.ravel()), (f1, f2), rtol=1e-5)


@pytest.mark.parametrize("shared", [True, False])
def test_focal_lengths_are_found_among_outliers(shared):
    squared, rotations = [], []
    for seed in range(60 if IS_WHOLE else 30):
        p = two_view_problem(500, 0.3, 0.5, seed)
        config = RansacConfig(max_error_px=2)
        if shared:
            found = estimate_motion_and_shared_focal(p.pixels1, p.pixels2, CENTER, config)
        else:
            found = estimate_motion_and_focals(p.pixels1, p.pixels2, CENTER, CENTER, config)
        assert found.success
        rotation = (
            Rotation3(found.model.cam2_from_cam1.rotation) @ Rotation3(p.cam2_from_cam1.rotation).inverse()
        )
        rotations.append(np.degrees(rotation.angle_rad()))
        squared.append(np.log(found.model.focal1_px / 800.0) ** 2 / found.covariance[5, 5])
    assert np.median(rotations) < 0.1 and np.percentile(rotations, 90) < 1.0
    assert np.median(np.abs(squared)) < 2.5 * chi2.ppf(0.5, 1)
    assert np.mean(np.array(squared) < chi2.ppf(0.99, 1)) > 0.8


@pytest.mark.parametrize("noise_px", [0.0, 0.3])
def test_axes_that_meet_leave_two_focal_lengths_undetermined(noise_px):
    """Both axes in one plane with the baseline: exact matches are degenerate, noisy ones know nothing of the lens."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.5, -1.2, 4], [1.5, 1.2, 8], (300, 3))
    rotation = Rotation3.exp(np.array([0.0, 0.25, 0.0]))
    center = np.array([0.0, 0.0, 6.0]) - 6.0 * (rotation.inverse().matrix @ [0.0, 0.0, 1.0])
    motion = Rigid3(rotation.matrix, -rotation.matrix @ center)
    pixels = [800 * x[:, :2] / x[:, 2:] + CENTER for x in (points, motion.apply(points))]
    x1, x2 = (p + noise_px * rng.normal(size=p.shape) for p in pixels)
    found = estimate_motion_and_focals(x1, x2, CENTER, CENTER)
    if noise_px == 0.0:
        assert found.reason is Reason.DEGENERATE and not np.isfinite(found.covariance).any()
    else:
        assert np.sqrt(found.covariance[5, 5]) > 1.0  # of the logarithm: a factor of e either way


def test_nothing_to_go_on():
    none = np.zeros((0, 2))
    assert estimate_motion_and_shared_focal(none, none, CENTER).reason is Reason.TOO_FEW
    nan = np.full((20, 2), np.nan)
    assert estimate_motion_and_focals(nan, nan, CENTER, CENTER).reason is Reason.TOO_FEW
