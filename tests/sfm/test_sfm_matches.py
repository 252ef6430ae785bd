"""Which matches count: those within the noise of their pair."""

import numpy as np
import pytest

from epipole.geometry import Rigid3
from epipole.pipelines.sfm.matching.match_stage import MAD_TO_SIGMA, within_noise
from epipole.robust import PairGeometry, PairKind

ANY = np.full((3, 3), np.nan)


def geometry(residuals_px: np.ndarray, kind: PairKind = PairKind.GENERAL) -> PairGeometry:
    return PairGeometry(
        kind,
        residuals_px < 4.0,
        Rigid3(np.eye(3), np.array([1.0, 0.0, 0.0])),
        *(ANY, ANY, ANY),
        0.2,
        0.3,
        residuals_px,
        np.zeros(4),
    )


@pytest.mark.parametrize(("sigma_px", "limit_px"), [(0.1, 1.5), (0.5, 2.5), (2.0, 4.0)])
def test_the_limit_is_five_sigma_between_two_bounds(sigma_px: float, limit_px: float) -> None:
    residuals = np.append(np.full(101, sigma_px / MAD_TO_SIGMA), [0.99 * limit_px, 1.01 * limit_px])
    kept = within_noise(geometry(residuals), 4.0)
    assert kept[:102].all() and not kept[102]


def test_wrong_matches_do_not_raise_the_limit(rng: np.random.Generator) -> None:
    right, wrong = np.abs(rng.normal(0.0, 0.3, 600)), rng.uniform(1.6, 4.0, 200)
    kept = within_noise(geometry(np.concatenate([right, wrong])), 4.0)
    assert kept[:600].mean() > 0.99 and kept[600:].mean() < 0.4


@pytest.mark.parametrize("kind", [PairKind.ROTATION, PairKind.NO_MOTION])
def test_pairs_without_epipolar_lines_keep_their_inliers(kind: PairKind) -> None:
    residuals = np.array([0.1, 0.1, 0.1, 3.9, 4.1])
    assert within_noise(geometry(residuals, kind), 4.0).tolist() == [True] * 4 + [False]
