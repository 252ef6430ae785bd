"""Many pairs at once: their kinds against made-up truth, alone and in a list, and on real images."""

import numpy as np
import pytest

from epipole import _parallel
from epipole.config import RansacConfig
from epipole.robust import PairKind, PairMatches, verify_pair, verify_pairs
from epipole.synthetic.problems import two_view_problem

KINDS = {"general": PairKind.GENERAL, "planar": PairKind.PLANAR, "rotation": PairKind.ROTATION}


def made_up(count, noise_px=0.7, outliers=0.3):
    pairs, truth = [], []
    for seed in range(count):
        name = ("general", "planar", "rotation", "rest")[seed % 4]
        p = two_view_problem(300, outliers, noise_px, seed, kind="general" if name == "rest" else name)
        second = p.pixels2
        if name == "rest":
            rng = np.random.default_rng(seed)
            second = np.where(
                p.inlier_mask[:, None], p.pixels1 + noise_px * rng.normal(size=second.shape), second
            )
        pairs.append(PairMatches(p.pixels1, second, p.camera1, p.camera2, seed=seed))
        truth.append(KINDS.get(name, PairKind.NO_MOTION))
    return pairs, truth


@pytest.mark.parametrize("noise_px", [0.3, 1.0])
def test_kinds_are_named(noise_px):
    pairs, truth = made_up(80, noise_px)
    found = verify_pairs(pairs, RansacConfig(max_error_px=3))
    assert np.mean([g.kind is t for g, t in zip(found, truth)]) >= 0.97
    of_general = [g.noise_px for g, t in zip(found, truth) if t is g.kind is PairKind.GENERAL]
    assert np.median(of_general) == pytest.approx(noise_px, rel=0.04)
    for g, t in zip(found, truth):
        assert np.isfinite(g.median_angle_rad) == (g.kind in (PairKind.GENERAL, PairKind.PLANAR))
        if t is PairKind.GENERAL and g.kind is t:
            # 210 residuals tell their deviation to 1 / sqrt(420), 5 %: four such are 20 %.
            assert g.noise_px == pytest.approx(noise_px, rel=0.2)
            assert "degrees" in g.explanation and "epipolar" in g.explanation
        if t is PairKind.ROTATION and g.kind is t:
            assert "no depth" in g.explanation and not g.cam2_from_cam1.translation.any()


def test_a_pair_has_one_answer_alone_in_a_list_and_on_any_threads():
    pairs, _ = made_up(12)
    _parallel.set_num_threads(2)
    together = verify_pairs(pairs)
    _parallel.set_num_threads(1)
    alone = [verify_pairs([pair])[0] for pair in pairs]
    _parallel.set_num_threads(None)
    for a, b in zip(together, alone):
        np.testing.assert_array_equal(a.inlier_mask, b.inlier_mask)
        np.testing.assert_array_equal(a.fundamental, b.fundamental)
        np.testing.assert_array_equal(a.costs, b.costs)


def test_pairs_of_nothing(rng):
    camera = two_view_problem(10, 0.0, 0.0, 0).camera1
    none = np.zeros((0, 2))
    noise = rng.uniform(0, 900, (60, 2)), rng.uniform(0, 900, (60, 2))
    nan = np.full((40, 2), np.nan)
    same = np.full((40, 2), 100.0)
    pairs = [
        PairMatches(a, b, camera, camera, known)
        for a, b in ((none, none), noise, (nan, nan))
        for known in (True, False)
    ]
    found = verify_pairs(pairs, RansacConfig(max_error_px=1))
    assert all(g.kind is PairKind.DEGENERATE and not g.inlier_mask.any() for g in found)
    assert all("too few" in g.explanation for g in found)
    assert verify_pairs([]) == []
    still = verify_pair(same, same, camera, camera, is_calibrated=False)
    assert still.kind in (PairKind.DEGENERATE, PairKind.NO_MOTION)
