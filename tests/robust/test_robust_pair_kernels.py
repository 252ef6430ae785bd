"""Fits and verdicts of many pairs against the interpreter."""

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.config import RansacConfig
from epipole.robust import PairKind, PairMatches, verify_pairs
from epipole.robust.pairs import _model_selection_kernels as selection_kernels
from epipole.robust.pairs import _pair_kernels as kernels
from epipole.robust.pairs import batch as pair_batch
from epipole.robust.pairs import verify
from epipole.robust.pairs._wide_pair_kernels import fit_wide_motions
from epipole.synthetic.problems import two_view_problem
from kernel_references import assert_same, assert_same_as_python, both_ways, record_calls, reference_of

FEW = RansacConfig(max_error_px=3.0, min_iterations=3, max_iterations=8, min_inliers=8)
FISHEYE = Camera(CameraModel.OPENCV_FISHEYE, 1280, 960, np.array([400.0, 410.0, 640.0, 480.0, 0.01, 0, 0, 0]))
# Sums may be taken in any order (`reassoc`), and a descent stops when it gains little.
ORDER = {"rtol": 1e-5, "atol": 1e-9, "of_largest": 1e-6, "only_written": True}
CALLERS = {
    kernels.fit_motions: pair_batch,
    fit_wide_motions: pair_batch,
    kernels.fit_fundamentals: verify,
    kernels.fit_homographies: verify,
    selection_kernels.select_models: verify,
}
FITS = kernels.fit_motions, kernels.fit_fundamentals, kernels.fit_homographies, fit_wide_motions


def some_pairs(is_calibrated: bool) -> list[PairMatches]:
    """A pair of each kind, of a wide lens, of matches of which some are no numbers, of too few, of one, and of none."""
    pairs = []
    for seed, kind in enumerate(("general", "planar", "rotation")):
        p = two_view_problem(28, 0.1, 0.5, seed, kind=kind)
        pairs.append(PairMatches(p.pixels1, p.pixels2, p.camera1, p.camera2, is_calibrated, seed))
    p = two_view_problem(24, 0.0, 0.0, 7)
    rays1, rays2 = p.camera1.unproject(p.pixels1), p.camera2.unproject(p.pixels2)
    second = p.pixels1 + 0.3 * np.random.default_rng(0).normal(size=p.pixels1.shape)
    pairs.append(PairMatches(p.pixels1, second, p.camera1, p.camera2, is_calibrated))
    wide = FISHEYE.project(rays1), FISHEYE.project(rays2)
    pairs.append(PairMatches(*wide, FISHEYE, FISHEYE, is_calibrated))
    unknown = p.pixels1.copy()
    unknown[::3] = np.nan
    pairs.append(PairMatches(unknown, p.pixels2, p.camera1, p.camera2, is_calibrated))
    for few in (6, 1, 0):
        pairs.append(PairMatches(p.pixels1[:few], p.pixels2[:few], p.camera1, p.camera2, is_calibrated))
    return pairs


@pytest.mark.parametrize("is_calibrated", [True, False])
@reference_of(
    kernels.fit_motions,
    kernels.fit_fundamentals,
    kernels.fit_homographies,
    selection_kernels.select_models,
    fit_wide_motions,
)
def test_pairs(monkeypatch: pytest.MonkeyPatch, is_calibrated: bool) -> None:
    calls = {kernel: record_calls(monkeypatch, module, kernel) for kernel, module in CALLERS.items()}
    kinds = {geometry.kind for geometry in verify_pairs(some_pairs(is_calibrated), FEW)}
    assert {PairKind.DEGENERATE, PairKind.NO_MOTION} <= kinds
    for kernel, recorded in calls.items():
        assert bool(recorded) == (kernel is not kernels.fit_fundamentals or not is_calibrated)
        for arguments in recorded:
            assert_same_as_python(kernel, *arguments, **ORDER)


@reference_of(kernels.fit_motions, kernels.fit_fundamentals, kernels.fit_homographies, fit_wide_motions)
def test_no_pair_is_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = {kernel: record_calls(monkeypatch, CALLERS[kernel], kernel) for kernel in FITS}
    verify_pairs(some_pairs(False), FEW)
    for kernel, recorded in calls.items():
        pairs, *wanted, use, quality, search, fits = recorded[0]
        nothing = [np.zeros_like(w) for w in wanted]
        _, (*_, after) = assert_same_as_python(
            kernel, pairs, *nothing, np.zeros_like(use), quality, search, fits
        )
        assert not (after.residuals_px < np.inf).any()


@reference_of(kernels.fit_motions)
def test_matches_that_coincide(monkeypatch: pytest.MonkeyPatch) -> None:
    """All motions explain them: rounding says which one comes, but not how well it fits."""
    calls = record_calls(monkeypatch, pair_batch, kernels.fit_motions)
    p, same = two_view_problem(1), np.full((12, 2), 5.0)
    verify_pairs([PairMatches(same, same, p.camera1, p.camera2)], FEW)
    (_, ours), (_, theirs) = both_ways(kernels.fit_motions, *calls[0])
    assert_same(ours[-1].residuals_px, theirs[-1].residuals_px, atol=1e-9)
    assert_same(ours[-1].iterations, theirs[-1].iterations)
