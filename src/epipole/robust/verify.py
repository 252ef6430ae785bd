"""Verification of pairs of images: which model explains their matches, and what that says about depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from epipole import _parallel
from epipole._checks import as_points, require_same_length
from epipole.cameras import Camera
from epipole.config import RansacConfig, options_of
from epipole.geometry import Rigid3
from epipole.geometry.epipolar import (
    essential_from_fundamental,
    fundamental_from_essential,
)
from epipole.robust import _model_selection_kernels as selection_kernels
from epipole.robust import _pair_kernels as kernels
from epipole.robust._problem_kernels import MODEL_SIZE
from epipole.robust._wide_pair_kernels import fit_wide_motions
from epipole.robust.pair_kind import PairKind
from epipole.robust.rays import is_wide

PLANE_SHARE = 0.7
"""A plane that explains less of the epipolar inliers than this could not win, and is not searched for."""
PLANE_ITERATIONS = 500
GUESS_FACTOR, GUESS_ITERATIONS = 3.0, 200
"""A guessed focal length is forgiven a threshold this many times as wide."""
STILL_PX = 0.75
"""A median shift of matches below this leaves no epipolar line worth following."""
_KINDS = (PairKind.GENERAL, PairKind.PLANAR, PairKind.ROTATION, PairKind.NO_MOTION)
"""Of the models, in the order of their costs."""
_CHUNKS = 256
_WORDS = ("epipolar geometry", "a plane", "a rotation", "no motion")


@dataclass(frozen=True, slots=True, eq=False)
class PairMatches:
    """Matched pixels of two images and their cameras."""

    pixels1: Float64[np.ndarray, "n 2"]
    pixels2: Float64[np.ndarray, "n 2"]
    camera1: Camera
    camera2: Camera
    is_calibrated: bool = True
    """Both focal lengths can be trusted; else they are guesses, and a fundamental matrix is fitted."""
    seed: int = 0
    """Added to the configuration's: a pair keeps its answer in whatever list it stands."""


@dataclass(frozen=True, slots=True, eq=False)
class PairGeometry:
    """What the matches of one pair of images say."""

    kind: PairKind
    inlier_mask: Bool[np.ndarray, " n"]
    cam2_from_cam1: Rigid3
    """|t| = 1, or 0 for a pure rotation; NaN where unknown."""
    essential: Float64[np.ndarray, "3 3"]
    fundamental: Float64[np.ndarray, "3 3"]
    homography: Float64[np.ndarray, "3 3"]
    median_angle_rad: float
    """Median angle between the rays of inliers in front of both cameras; NaN where there is no motion."""
    noise_px: float
    """Standard deviation of the matches, from the epipolar residuals."""
    costs: Float64[np.ndarray, 4]
    """Torr's GRIC of epipolar geometry, plane, rotation and no motion, lower is better; NaN where nothing was found."""

    @property
    def explanation(self) -> str:
        """In words, why the pair is of this kind."""
        if self.kind is PairKind.DEGENERATE:
            return f"too few of {len(self.inlier_mask)} matches agree with any geometry"
        order = np.argsort(self.costs)
        margin = float(self.costs[order[1]] - self.costs[order[0]])
        if self.kind is PairKind.ROTATION and order[0] != selection_kernels.ROTATION:
            return "a plane fits best, and a rotation under the guessed focal length fits nearly all: no depth in it"
        words = (
            f"{_WORDS[order[0]]} explains {int(self.inlier_mask.sum())} matches with {self.noise_px:.2f} px of noise best "
            f"(by {margin:.0f} over {_WORDS[order[1]]})"
        )
        if np.isfinite(self.median_angle_rad):
            return f"{words}; rays meet at {np.degrees(self.median_angle_rad):.1f} degrees"
        return f"{words}; there is no depth in it"


def verify_pairs(pairs: Sequence[PairMatches], config: RansacConfig | None = None) -> list[PairGeometry]:
    """Name what each pair is: general, planar, rotation only, no motion, or degenerate.

    An essential (or fundamental) matrix is fitted robustly; a homography, a rotation and the resting camera compete
    with it over its inliers by the geometric robust information criterion (Torr, PhilTrans A 1998), with the noise
    estimated from the matches. Pairs are spread over the threads; the answers do not depend on their number.

    Args:
        pairs: matches and cameras.
        config: threshold in pixels, inliers needed, and seed.

    Raises:
        ShapeError: the pixels of a pair do not fit.
    """
    config = options_of(RansacConfig, config)
    parts = _parallel.map_chunks(lambda a, b, _: _verify(pairs[a:b], config), len(pairs), _CHUNKS)
    return [geometry for part in parts for geometry in part]


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


def find_guide(
    pixels1: Any,
    pixels2: Any,
    camera1: Camera,
    camera2: Camera,
    *,
    is_calibrated: bool,
    config: RansacConfig,
) -> Float64[np.ndarray, "3 3"] | None:
    """The fundamental matrix along whose lines more matches may be sought; None where too few agree or none move."""
    pair = PairMatches(pixels1, pixels2, camera1, camera2, is_calibrated)
    packed = _pack([pair], config)
    epipolar, motions = _fit_epipolar(packed, np.array([is_calibrated]), config)
    inliers = epipolar.residuals_px < config.max_error_px
    if epipolar.iterations[0] < 0 or inliers.sum() < config.min_inliers:
        return None
    shift = packed.pixels[2:, inliers] - packed.pixels[:2, inliers]
    if np.median(np.hypot(shift[0], shift[1])) < STILL_PX:
        return None
    return _matrices(pair, 0, epipolar, motions)[1]


def _verify(pairs: Sequence[PairMatches], config: RansacConfig) -> list[PairGeometry]:
    packed = _pack(pairs, config)
    n = len(pairs)
    calibrated = np.array([pair.is_calibrated for pair in pairs], bool)
    epipolar, motions = _fit_epipolar(packed, calibrated, config)
    inliers = epipolar.residuals_px < config.max_error_px
    if not calibrated.all():
        loose = _search(config, factor=GUESS_FACTOR, most=GUESS_ITERATIONS)
        _fit_motions(packed, ~calibrated, inliers, loose, motions)
    planes = _no_fits(packed)
    plane_search = _search(config, most=PLANE_ITERATIONS, share=PLANE_SHARE)
    kernels.fit_homographies(packed, inliers, plane_search, planes)
    selection = selection_kernels.Selection(
        np.zeros(n, np.int64), np.zeros((n, 4)), np.zeros(n), np.zeros((n, 9)), np.zeros(n)
    )
    selection_kernels.select_models(packed, calibrated, _search(config), epipolar, planes, motions, selection)
    return [
        _geometry(pair, p, packed.offsets, inliers, epipolar, planes, motions, selection)
        for p, pair in enumerate(pairs)
    ]


def _fit_epipolar(
    packed: kernels.Pairs, calibrated: np.ndarray, config: RansacConfig
) -> tuple[kernels.Fits, kernels.Fits]:
    """What explains each pair, E where calibrated and F elsewhere; and the motions of calibrated pairs."""
    finite = np.isfinite(packed.pixels).all(axis=0)
    epipolar, motions, search = _no_fits(packed), _no_fits(packed), _search(config)
    if not calibrated.all():
        kernels.fit_fundamentals(packed, ~calibrated, finite, search, epipolar)
    if calibrated.any():
        _fit_motions(packed, calibrated, finite, search, motions)
        of_calibrated = np.repeat(calibrated, np.diff(packed.offsets))
        np.copyto(epipolar.residuals_px, motions.residuals_px, where=of_calibrated)
        np.copyto(epipolar.iterations, motions.iterations, where=calibrated)
    return epipolar, motions


def _fit_motions(
    packed: kernels.Pairs,
    wanted: np.ndarray,
    use: np.ndarray,
    search: kernels.Search,
    motions: kernels.Fits,
) -> None:
    """Relative poses, of wide lenses on their rays."""
    wide = wanted & (packed.wide[packed.camera1] | packed.wide[packed.camera2])
    if (wanted & ~wide).any():
        kernels.fit_motions(packed, wanted & ~wide, use, search, motions)
    if wide.any():
        fit_wide_motions(packed, wide, use, search, motions)


def _pack(pairs: Sequence[PairMatches], config: RansacConfig) -> kernels.Pairs:
    columns = []
    for pair in pairs:
        p1, p2 = as_points(pair.pixels1, "pixels1", 2), as_points(pair.pixels2, "pixels2", 2)
        require_same_length(pixels1=p1, pixels2=p2)
        columns.append(np.concatenate([p1, p2], axis=1))
    cameras = list({id(c): c for pair in pairs for c in (pair.camera1, pair.camera2)}.values())
    row = {id(camera): k for k, camera in enumerate(cameras)}
    return kernels.Pairs(
        np.ascontiguousarray(np.concatenate(columns).T),
        np.concatenate([[0], np.cumsum([len(c) for c in columns])]).astype(np.int64),
        np.array([row[id(pair.camera1)] for pair in pairs], np.int64),
        np.array([row[id(pair.camera2)] for pair in pairs], np.int64),
        np.array([int(c.model) for c in cameras], np.int64),
        np.stack([c.padded_params() for c in cameras]),
        np.array([c.focal_px for c in cameras]),
        np.array([is_wide(c) for c in cameras], bool),
        np.array([(config.seed + pair.seed) % 2**64 for pair in pairs], np.uint64),
    )


def _no_fits(packed: kernels.Pairs) -> kernels.Fits:
    n = len(packed.seed)
    return kernels.Fits(
        np.full((n, MODEL_SIZE), np.nan),
        np.full(packed.pixels.shape[1], np.inf),
        np.zeros((n, 5)),
        np.full(n, -1, np.int64),
    )


def _search(
    config: RansacConfig, factor: float = 1.0, most: int | None = None, share: float | None = None
) -> kernels.Search:
    most = config.max_iterations if most is None else min(most, config.max_iterations)
    return kernels.Search(
        float(factor * config.max_error_px),
        float(config.confidence),
        min(config.min_iterations, most),
        most,
        config.min_inliers,
        float(config.min_inlier_ratio if share is None else share),
    )


def _in_pixels(fits: kernels.Fits, p: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The fitted matrix and the maps of both pictures' pixels to its coordinates."""
    u1, v1, u2, v2, s = fits.frame[p]
    t1, t2 = (np.array([[1 / s, 0, -u / s], [0, 1 / s, -v / s], [0, 0, 1]]) for u, v in ((u1, v1), (u2, v2)))
    return fits.raw[p, :9].reshape(3, 3), t1, t2


def _matrices(
    pair: PairMatches, p: int, epipolar: kernels.Fits, motions: kernels.Fits
) -> tuple[np.ndarray, np.ndarray]:
    """(E, F), of length one."""
    if pair.is_calibrated:
        essential = motions.raw[p, 12:21].reshape(3, 3)
        fundamental = fundamental_from_essential(essential, pair.camera1.K, pair.camera2.K)
    else:
        inner, t1, t2 = _in_pixels(epipolar, p)
        fundamental = t2.T @ inner @ t1
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
        if planes.iterations[p] >= 0:
            inner, t1, t2 = _in_pixels(planes, p)
            homography = np.linalg.solve(t2, inner @ t1)
            homography = homography / np.linalg.norm(homography)
    if kind is PairKind.ROTATION:
        motion = Rigid3(selection.rotation[p].reshape(3, 3).copy(), np.zeros(3))
    if not pair.is_calibrated and kind in (PairKind.GENERAL, PairKind.PLANAR):
        # A plane seen by unknown lenses still has the F that was found; nothing says what its motion is.
        kind = PairKind.UNCALIBRATED
    return PairGeometry(
        *(kind, own, motion, essential, fundamental, homography),
        *(float(selection.median_angle_rad[p]), float(selection.noise_px[p]), selection.cost[p].copy()),
    )
