"""Self-calibration: focal lengths of unknown cameras from fundamental matrices."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from epipole.robust import PairKind
from epipole.scene import Cameras, ViewGraph

FACTORS = np.geomspace(0.25, 4.0, 49)
"""Focal lengths that are tried, as factors of the guess, in steps of 6 %."""
MIN_INLIERS = 50
FULL_WEIGHT_INLIERS = 500
WIDTHS = (0.1, 0.05, 0.02, 0.01)
"""Disagreement at which a vote has half its weight: first wide, to find the maximum, then narrow, to refine it."""
MAX_SWEEPS = 20
MAX_PAIRS_OF_CAMERA = 40
CLEAR_VOTE = 2.0
"""A focal length is accepted if its votes are this many times the median over all factors."""
PRIOR_VOTE, PRIOR_WIDTH = 50.0, 0.7
"""The initial guess votes like a pair with this many matches; its vote is halved at a factor of e^width."""


@dataclass(frozen=True, slots=True, eq=False)
class Ballot:
    """Vote of a pair of images: its disagreement for all combinations of both cameras' factors."""

    first: int
    second: int
    weight: float
    disagreement: np.ndarray
    """(factors of first, factors of second), one row or column for a trusted camera; (n, 1) for a single camera."""


def estimate_focals(
    cameras: Cameras, camera_of_image: np.ndarray, view_graph: ViewGraph
) -> tuple[Cameras, dict[int, float]]:
    """Estimate the focal lengths of untrusted cameras from pairs of their images.

    An essential matrix has two equal singular values (Huang and Faugeras, PAMI 1989), so the focal lengths in K2^T F K1
    are right where these agree best. Every pair votes over a logarithmic range of both its cameras' factors; votes are
    weighted by inliers and bounded, so that planar and forward-moving pairs, whose votes are flat or wrong, have little
    influence. (Search instead of solving: Mendonca and Cipolla, CVPR 1999; all cameras jointly and robustly: Fetzer,
    Reis, Stricker, WACV 2020.) The maximum is found by coordinate ascent, one camera at a time and then all by a common
    factor, which pairs of similar cameras determine least.

    Returns:
        Cameras with the new estimates, and the factor of each camera that got one.
    """
    unknown = ~cameras.is_focal_trusted & ~cameras.is_constant
    ballots = ballots_of(cameras, camera_of_image, view_graph, unknown)
    of_camera = _by_camera(ballots, unknown)
    chosen = climbed(ballots, unknown)
    found = {}
    for c, index in sorted(chosen.items()):
        votes = _votes(c, chosen, of_camera[c], WIDTHS[-1])
        # A flat vote has no information, so the guess is kept.
        if votes[index] >= CLEAR_VOTE * np.median(votes) and 0 < index < len(FACTORS) - 1:
            found[c] = float(FACTORS[index])
    params, trusted = cameras.params.copy(), cameras.is_focal_trusted.copy()
    for c, factor in found.items():
        params[c, list(cameras[c].model.focal_indices)] *= factor
        trusted[c] = True
    return replace(cameras, params=params, is_focal_trusted=trusted), found


def climbed(
    ballots: list[Ballot], unknown: np.ndarray, start: int = len(FACTORS) // 2, factor: float = 1.0
) -> dict[int, int]:
    """Factor with the most votes for each unknown camera, as a row of FACTORS; starts at row `start` times `factor`."""
    of_camera = _by_camera(ballots, unknown)
    first = int(np.argmin(np.abs(np.log(FACTORS / (factor * FACTORS[start])))))
    chosen = dict.fromkeys(sorted(of_camera, key=lambda c: -sum(b.weight for b in of_camera[c])), first)
    for width in WIDTHS:
        _climb(chosen, ballots, of_camera, width)
    return chosen


def _by_camera(ballots: list[Ballot], unknown: np.ndarray) -> dict[int, list[Ballot]]:
    of_camera: dict[int, list[Ballot]] = {}
    for ballot in ballots:
        for c in {ballot.first, ballot.second}:
            if unknown[c]:
                of_camera.setdefault(c, []).append(ballot)
    return of_camera


def ballots_of(
    cameras: Cameras, camera_of_image: np.ndarray, view_graph: ViewGraph, unknown: np.ndarray
) -> list[Ballot]:
    """Votes of pairs with enough matches, strongest first, and at most MAX_PAIRS_OF_CAMERA per camera."""
    first, second = camera_of_image[view_graph.image1], camera_of_image[view_graph.image2]
    inliers = view_graph.num_inliers()
    usable = (view_graph.kind == PairKind.UNCALIBRATED) & (inliers >= MIN_INLIERS)
    usable &= unknown[first] | unknown[second]
    taken = np.zeros(len(cameras), int)
    one = np.ones(1)
    out = []
    for edge in np.flatnonzero(usable)[np.argsort(-inliers[usable], kind="stable")]:
        a, b = int(first[edge]), int(second[edge])
        # The strongest pairs of a camera are enough.
        if max(taken[a] if unknown[a] else 0, taken[b] if unknown[b] else 0) >= MAX_PAIRS_OF_CAMERA:
            continue
        taken[[a, b]] += 1
        F, K1, K2 = view_graph.fundamental[edge], cameras[a].K, cameras[b].K
        if a == b:
            table = singular_value_disagreement(F, K1, K2, FACTORS, FACTORS)[:, None]
        else:
            rows = FACTORS[:, None] if unknown[a] else one[:, None]
            columns = FACTORS[None] if unknown[b] else one[None]
            table = singular_value_disagreement(F, K1, K2, rows, columns)
        out.append(Ballot(a, b, float(min(inliers[edge], FULL_WEIGHT_INLIERS)), table))
    return out


def singular_value_disagreement(
    fundamental: Float64[np.ndarray, "3 3"],
    K1: Float64[np.ndarray, "3 3"],
    K2: Float64[np.ndarray, "3 3"],
    factors1: np.ndarray,
    factors2: np.ndarray,
) -> np.ndarray:
    """1 - s1 / s0 of E = K2^T F K1 with the focal lengths multiplied by these factors (broadcast together).

    For rank two, s0^2 + s1^2 = |E|^2 and (s0 s1)^2 is the sum of the squares of all 2 x 2 minors of E.
    """

    def scaled(K: np.ndarray, factors: np.ndarray) -> np.ndarray:
        out = np.broadcast_to(K, (*factors.shape, 3, 3)).copy()
        out[..., [0, 1], [0, 1]] *= factors[..., None]
        return out

    E = np.swapaxes(scaled(K2, factors2), -1, -2) @ fundamental @ scaled(K1, factors1)
    total = (E**2).sum(axis=(-2, -1))
    rows = [np.cross(E[..., i, :], E[..., (i + 1) % 3, :]) for i in range(3)]
    product = sum((r**2).sum(axis=-1) for r in rows)
    apart = np.sqrt(np.maximum(total**2 - 4.0 * product, 0.0))
    return 1.0 - np.sqrt(np.maximum(total - apart, 0.0) / np.maximum(total + apart, 1e-300))


def _climb(
    chosen: dict[int, int], ballots: list[Ballot], of_camera: dict[int, list[Ballot]], width: float
) -> None:
    """Move each camera, then all together, to the factor with the most votes, until nothing changes."""
    for _ in range(MAX_SWEEPS if chosen else 0):
        before = dict(chosen)
        for c in chosen:
            chosen[c] = int(np.argmax(_votes(c, chosen, of_camera[c], width)))
        low, high = -min(chosen.values()), len(FACTORS) - max(chosen.values())
        totals = _totals(chosen, ballots, width, np.arange(low, high))
        if totals.max() > totals[-low] + 1e-9:
            shift = low + int(np.argmax(totals))
            chosen.update({c: index + shift for c, index in chosen.items()})
        if chosen == before:
            break


def _votes(c: int, chosen: dict[int, int], ballots: list[Ballot], width: float) -> np.ndarray:
    """Votes for every factor of camera c, with the other cameras fixed."""
    votes = _prior_votes()
    for b in ballots:
        if b.first == b.second:
            column = b.disagreement[:, 0]
        elif b.first == c:
            column = b.disagreement[:, chosen.get(b.second, 0)]
        else:
            column = b.disagreement[chosen.get(b.first, 0)]
        votes = votes + b.weight / (1.0 + (column / width) ** 2)
    return votes


def _totals(chosen: dict[int, int], ballots: list[Ballot], width: float, shifts: np.ndarray) -> np.ndarray:
    """Total votes after shifting the factors of all cameras by each number of rows."""
    votes = _prior_votes()[np.array(list(chosen.values()))[:, None] + shifts].sum(axis=0)
    still = np.zeros(len(shifts), np.int64)
    for b in ballots:
        row, column = (chosen[c] + shifts if c in chosen else still for c in (b.first, b.second))
        column = still if b.first == b.second else column
        votes += b.weight / (1.0 + (b.disagreement[row, column] / width) ** 2)
    return votes


def _prior_votes() -> np.ndarray:
    return PRIOR_VOTE / (1.0 + (np.log(FACTORS) / PRIOR_WIDTH) ** 2)
