"""What estimators between two views ask kernels besides the loop, against derivatives and the interpreter."""

import numpy as np
import pytest

from epipole.config import RansacConfig
from epipole.geometry import Rotation3
from epipole.robust import estimate_fundamental_matrix
from epipole.robust.pairs import _fundamental_kernels as fundamental
from epipole.robust.pairs import _relative_pose_kernels as relative
from epipole.robust.pairs import two_view
from epipole.synthetic.problems import dominant_plane_problem, two_view_problem
from kernel_references import assert_same_as_python, record_calls, reference_of


@reference_of(relative.tangent_of_direction)
def test_tangents(rng: np.random.Generator) -> None:
    directions = [*rng.normal(size=(5, 3)), *np.eye(3), *-np.eye(3), np.ones(3)]
    for t in directions:
        t = t / np.linalg.norm(t)
        _, (_, basis) = assert_same_as_python(relative.tangent_of_direction, t, np.empty((2, 3)))
        both = np.vstack([basis, t])
        np.testing.assert_allclose(both @ both.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(both) > 0
    assert_same_as_python(relative.tangent_of_direction, np.full(3, np.nan), np.empty((2, 3)))


def composed(u: np.ndarray, v: np.ndarray, ratio: float) -> np.ndarray:
    return u @ np.diag([1.0, ratio, 0.0]) @ v.T


@pytest.mark.parametrize("ratio", [0.7, 1.0, 0.0])
@reference_of(fundamental.derivatives_of_fundamental)
def test_derivatives(rng: np.random.Generator, ratio: float) -> None:
    u, v = (Rotation3.exp(rng.normal(size=3)).matrix for _ in range(2))
    model = np.full(32, np.nan)
    model[9:18], model[18:27], model[fundamental.RATIO] = u.ravel(), v.ravel(), ratio
    _, (_, d) = assert_same_as_python(fundamental.derivatives_of_fundamental, model, np.empty((7, 9)))
    step, numeric = 1e-6, np.empty((7, 9))
    for c in range(7):
        ends = []
        for sign in (step, -step):
            rotation = Rotation3.exp(sign * np.eye(3)[c % 3]).matrix
            rotated = (u @ rotation if c < 3 else u), (v @ rotation if 3 <= c < 6 else v)
            ends.append(composed(*rotated, ratio + (sign if c == 6 else 0.0)))
        numeric[c] = (ends[0] - ends[1]).ravel() / (2 * step)
    np.testing.assert_allclose(d, numeric / np.hypot(1.0, ratio), atol=1e-9)


@reference_of(fundamental.parallax_support)
def test_support_off_the_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = record_calls(monkeypatch, two_view, fundamental.parallax_support)
    config = RansacConfig(max_error_px=2.0, min_inliers=8, min_iterations=3, max_iterations=10)
    for problem in (
        two_view_problem(40, 0.1, 0.3, 1, kind="planar"),
        dominant_plane_problem(60, 0.85, 0.0, 0.3, 2),
        two_view_problem(30, 0.0, 0.3, 3),
    ):
        estimate_fundamental_matrix(problem.pixels1, problem.pixels2, config)
    fractions = []
    for arguments in calls:
        # Sums may be taken in any order (`reassoc`).
        found, _ = assert_same_as_python(fundamental.parallax_support, *arguments, rtol=1e-9)
        fractions.append(found[0])
    assert min(fractions) < fundamental.DOMINANT < max(fractions)
