"""Verification of image pairs: the model that explains their matches, and whether it has depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from epipole import _parallel
from epipole._checks import Declared, checked
from epipole.cameras import Camera
from epipole.config import RansacConfig, options_of
from epipole.geometry import Rigid3
from epipole.geometry.epipolar import (
    essential_from_fundamental,
    fundamental_from_essential,
)
from epipole.robust.pairs import _model_selection_kernels as selection_kernels
from epipole.robust.pairs import _pair_kernels as kernels
from epipole.robust.pairs.batch import (
    fit_motions,
    no_fits,
    pack_pairs,
    search_for,
    to_coordinates,
    usable_matches,
)
from epipole.robust.pairs.kind import PairKind

PLANE_FRACTION = 0.7
"""Smallest useful fraction of epipolar inliers on a plane: with fewer, it could not win."""
PLANE_ITERATIONS = 500
GUESS_FACTOR = 3.0  # multiple of the threshold for guessed focal lengths
GUESS_ITERATIONS = 200
_KINDS = (PairKind.GENERAL, PairKind.PLANAR, PairKind.ROTATION, PairKind.NO_MOTION)
"""Kinds of the models, in the order of their costs."""
_CHUNKS = 64
_WORDS = ("epipolar geometry", "a plane", "a rotation", "no motion")


@dataclass(frozen=True, slots=True, eq=False)
class PairMatches(Declared):
    """Matched pixels of two images and their cameras."""

    pixels1: Float64[np.ndarray, "n 2"]
    pixels2: Float64[np.ndarray, "n 2"]
    camera1: Camera
    camera2: Camera
    is_calibrated: bool = True
    """Whether both focal lengths can be trusted; otherwise they are guesses, and a fundamental matrix is fitted."""
    seed: int = 0
    """Added to the configuration's seed, so that the result of a pair does not depend on the list."""

    def __repr__(self) -> str:
        return f"PairMatches({len(self.pixels1)} matches, {self.camera1!r}, {self.camera2!r})"


@dataclass(frozen=True, slots=True, eq=False)
class PairGeometry:
    """Geometry of one pair of images, from its matches."""

    kind: PairKind
    inlier_mask: Bool[np.ndarray, " n"]
    cam2_from_cam1: Rigid3
    """|t| = 1, or 0 for a pure rotation; NaN where unknown."""
    essential: Float64[np.ndarray, "3 3"]
    fundamental: Float64[np.ndarray, "3 3"]
    homography: Float64[np.ndarray, "3 3"]
    median_angle_rad: float
    """Median angle between the rays of inliers in front of both cameras; NaN without motion."""
    noise_px: float
    """Standard deviation of the matches, from the epipolar residuals."""
    residuals_px: Float64[np.ndarray, " n"]
    """Distance of each match from the epipolar geometry (Sampson), in pixels."""
    costs: Float64[np.ndarray, 4]
    """Torr's GRIC of epipolar geometry, plane, rotation and no motion, lower is better; NaN if nothing was found."""

    @property
    def explanation(self) -> str:
        """Why the pair is of this kind, in words."""
        if self.kind is PairKind.DEGENERATE:
            return f"too few of {len(self.inlier_mask)} matches agree with any geometry"
        order = np.argsort(self.costs)
        margin = float(self.costs[order[1]] - self.costs[order[0]])
        if self.kind is PairKind.ROTATION and order[0] != selection_kernels.ROTATION:
            return "a plane fits best, and a rotation with the guessed focal length fits nearly all matches, so there is no depth"
        words = (
            f"{_WORDS[order[0]]} explains {int(self.inlier_mask.sum())} matches best, with {self.noise_px:.2f} px of noise "
            f"(by {margin:.0f} over {_WORDS[order[1]]})"
        )
        if np.isfinite(self.median_angle_rad):
            return f"{words}; rays intersect at {np.degrees(self.median_angle_rad):.1f} degrees"
        return f"{words}; there is no depth"

    def __repr__(self) -> str:
        return f"PairGeometry({self.kind.name}: {self.explanation})"


@checked
def verify_pairs(pairs: Sequence[PairMatches], config: RansacConfig | None = None) -> list[PairGeometry]:
    """Classify pairs: general, planar, rotation only, no motion, or degenerate.

    An essential (or fundamental) matrix is fitted robustly; a homography, a rotation and no motion compete with it on its
    inliers by the geometric robust information criterion (Torr, PhilTrans A 1998), with the noise estimated from the matches.
    Pairs are processed in parallel; the results do not depend on the number of threads.

    Args:
        pairs: matches and cameras.
        config: threshold in pixels, minimum number of inliers, and seed.

    Raises:
        ShapeError: the two pixel arrays of a pair do not match.
    """
    config = options_of(RansacConfig, config)
    parts = _parallel.map_chunks(lambda a, b, _: _verify(pairs[a:b], config), len(pairs), _CHUNKS)
    return [geometry for part in parts for geometry in part]


@checked
def verify_pair(
    pixels1: Any,
    pixels2: Any,
    camera1: Camera,
    camera2: Camera,
    *,
    is_calibrated: bool,
    config: RansacConfig | None = None,
) -> PairGeometry:
    """`verify_pairs` of one pair."""
    return verify_pairs([PairMatches(pixels1, pixels2, camera1, camera2, is_calibrated)], config)[0]


def _verify(pairs: Sequence[PairMatches], config: RansacConfig) -> list[PairGeometry]:
    packed = _packed(pairs, config)
    n = len(pairs)
    calibrated = np.array([pair.is_calibrated for pair in pairs], bool)
    epipolar, motions = _fit_epipolar(packed, calibrated, config)
    inliers = epipolar.residuals_px < config.max_error_px
    if not calibrated.all():
        loose = search_for(config, factor=GUESS_FACTOR, most=GUESS_ITERATIONS)
        fit_motions(packed, ~calibrated, inliers, None, loose, motions)
    planes = no_fits(packed)
    plane_search = search_for(config, most=PLANE_ITERATIONS, fraction=PLANE_FRACTION)
    kernels.fit_homographies(packed, inliers, None, plane_search, planes)
    selection = selection_kernels.Selection(
        np.zeros(n, np.int64), np.zeros((n, 4)), np.zeros(n), np.zeros((n, 9)), np.zeros(n)
    )
    selection_kernels.select_models(
        packed, calibrated, search_for(config), epipolar, planes, motions, selection
    )
    return [
        _geometry(pair, p, packed.offsets, inliers, epipolar, planes, motions, selection)
        for p, pair in enumerate(pairs)
    ]


def _fit_epipolar(
    packed: kernels.Pairs, calibrated: np.ndarray, config: RansacConfig
) -> tuple[kernels.Fits, kernels.Fits]:
    """Epipolar fits, E if calibrated and F otherwise, and the motions of calibrated pairs."""
    use = usable_matches(packed)
    epipolar, motions, search = no_fits(packed), no_fits(packed), search_for(config)
    if not calibrated.all():
        kernels.fit_fundamentals(packed, ~calibrated, use, None, search, epipolar)
    if calibrated.any():
        fit_motions(packed, calibrated, use, None, search, motions)
        of_calibrated = np.repeat(calibrated, np.diff(packed.offsets))
        np.copyto(epipolar.residuals_px, motions.residuals_px, where=of_calibrated)
        np.copyto(epipolar.best_score, motions.best_score, where=calibrated)
    return epipolar, motions


def _packed(pairs: Sequence[PairMatches], config: RansacConfig) -> kernels.Pairs:
    return pack_pairs(
        [(pair.pixels1, pair.pixels2) for pair in pairs],
        [(pair.camera1, pair.camera2) for pair in pairs],
        [config.seed + pair.seed for pair in pairs],
    )


def _matrices(
    pair: PairMatches, p: int, epipolar: kernels.Fits, motions: kernels.Fits
) -> tuple[np.ndarray, np.ndarray]:
    """(E, F), of unit length."""
    if pair.is_calibrated:
        essential = motions.raw[p, 12:21].reshape(3, 3)
        fundamental = fundamental_from_essential(essential, pair.camera1.K, pair.camera2.K)
    else:
        t1, t2 = to_coordinates(epipolar, p)
        fundamental = t2.T @ epipolar.raw[p, :9].reshape(3, 3) @ t1
        essential = essential_from_fundamental(fundamental, pair.camera1.K, pair.camera2.K)
    return essential / np.linalg.norm(essential), fundamental / np.linalg.norm(fundamental)


def _geometry(
    pair: PairMatches,
    p: int,
    offsets: np.ndarray,
    inliers: np.ndarray,
    epipolar: kernels.Fits,
    planes: kernels.Fits,
    motions: kernels.Fits,
    selection: selection_kernels.Selection,
) -> PairGeometry:
    model = int(selection.model[p])
    kind = PairKind.DEGENERATE if model == selection_kernels.NONE else _KINDS[model]
    blank = np.full((3, 3), np.nan)
    own = inliers[offsets[p] : offsets[p + 1]].copy()
    essential, fundamental, homography = blank, blank, blank
    motion = Rigid3(blank, np.full(3, np.nan))
    if kind is PairKind.DEGENERATE:
        own[:] = False
    else:
        essential, fundamental = _matrices(pair, p, epipolar, motions)
        motion = Rigid3(motions.raw[p, :9].reshape(3, 3).copy(), motions.raw[p, 9:12].copy())
        if np.isfinite(planes.best_score[p]):
            t1, t2 = to_coordinates(planes, p)
            homography = np.linalg.solve(t2, planes.raw[p, :9].reshape(3, 3) @ t1)
            homography = homography / np.linalg.norm(homography)
    if kind is PairKind.ROTATION:
        motion = Rigid3(selection.rotation[p].reshape(3, 3).copy(), np.zeros(3))
    if not pair.is_calibrated and kind in (PairKind.GENERAL, PairKind.PLANAR):
        # A plane with unknown intrinsics still has F, but its motion is unknown.
        kind = PairKind.UNCALIBRATED
    return PairGeometry(
        kind,
        own,
        motion,
        essential,
        fundamental,
        homography,
        float(selection.median_angle_rad[p]),
        float(selection.noise_px[p]),
        epipolar.residuals_px[offsets[p] : offsets[p + 1]].copy(),
        selection.cost[p].copy(),
    )
