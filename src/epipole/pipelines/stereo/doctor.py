"""Diagnosis of a stereo pair: swapped images, misaligned rows and their cause, synchronization, units, expected depth error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64

from epipole.disparity_search.rectification import Rectification, rectify
from epipole.errors import EpipoleError, ShapeError
from epipole.pipelines.stereo.calibration_error import calibration_sigma
from epipole.pipelines.stereo.rigs import rectified_rig_of
from epipole.pipelines.stereo.rows import (
    LEAST_FOR_TREND,
    SAME_PX,
    RowMatches,
    fit_trend,
    is_swapped,
    match_features,
    row_basis,
    without_mistakes,
)
from epipole.scene import RectifiedRig, StereoRig

TYPICAL_SIGMA_PX = 0.25
"""Standard deviation of a good disparity, for the table of expected depth errors."""
GOOD_PX, BAD_PX = 0.5, 1.0
"""Thresholds of the vertical offset's median and 95th percentile for aligned and misaligned rows."""
_EXPLAINS, _LESS = 0.7, 0.9
_LARGE_BASELINE, _SMALL_BASELINE = 5.0, 1e-3
_UNSTEADY_PX, _UNSTEADY_SIGMAS = 0.3, 5.0
_GRID = 3


class Cause(StrEnum):
    """The likely cause of the vertical offsets, from their trend."""

    NONE = "rows match"
    EXTRINSICS = "the rig's geometry (rotation, principal point, focal length or direction of the baseline)"
    DISTORTION = "lens distortion"
    UNCLEAR = "blur, rolling shutter or moving objects (neither rig nor distortion explains the offsets)"
    UNKNOWN = "too few feature matches"


class _Finding(NamedTuple):
    words: str
    is_problem: bool


@dataclass(frozen=True, slots=True, eq=False)
class DepthExpectation:
    """Expected depth error at one depth."""

    depth: float
    disparity_px: float
    from_matching: float
    """Standard deviation due to disparity errors."""
    from_calibration: float
    """Standard deviation due to the calibration's covariance, at the image center; NaN without a covariance."""


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """Result of `examine`; `problems` is empty for a healthy pair."""

    problems: tuple[str, ...]
    notes: tuple[str, ...]
    num_matches: int
    vertical_median_px: float
    """Of the absolute offset."""
    vertical_p95_px: float
    vertical_signed_px: float
    """Signed median, positive if features are lower in the right image."""
    vertical_map_px: Float64[np.ndarray, "3 3"]
    """Median offset in each cell of a 3 x 3 grid; NaN without matches."""
    after_extrinsics_px: float
    """Robust standard deviation after fitting rotation, scale and direction of the baseline."""
    after_distortion_px: float
    """The same after also fitting radial distortion."""
    cause: Cause
    expectations: tuple[DepthExpectation, ...] = field(default=())

    @property
    def calibration_error_px(self) -> float:
        """Standard deviation of the vertical offsets explained by rig errors; horizontal ones are probably as large.

        Use it as `RectifiedRig.principal_offset_sigma_px` for a calibration without uncertainties.
        """
        total = 1.4826 * self.vertical_median_px
        return float(np.sqrt(max(total**2 - self.after_extrinsics_px**2, 0.0)))

    @property
    def is_healthy(self) -> bool:
        """Whether there are no problems."""
        return not self.problems

    def __repr__(self) -> str:
        found = "healthy" if self.is_healthy else "; ".join(self.problems)
        return f"Diagnosis({found}; {self.num_matches} matches)"


def examine(
    pairs: Sequence[tuple[np.ndarray, np.ndarray]], rig: StereoRig | RectifiedRig | None = None
) -> Diagnosis:
    """Examine one pair, or several of the same rig.

    Args:
        pairs: images, (h, w) or (h, w, 3), 8 bits; raw for a `StereoRig`, else rectified.
        rig: the cameras, if known.

    Raises:
        ShapeError: there is no pair, or the sizes of the images do not match each other or the calibration.
    """
    if not pairs:
        raise ShapeError("there is no pair to examine")
    if isinstance(rig, StereoRig):
        for left, right in pairs:
            rig.check_image_sizes(left, right)
    findings: list[_Finding] = []
    rectification: Rectification | None = None
    flat = rig if isinstance(rig, RectifiedRig) else None
    if isinstance(rig, StereoRig):
        try:
            flat = rectified_rig_of(rig)
            if flat is None:
                rectification = rectify(rig)
                flat = rectification.rig
        except EpipoleError as error:
            findings.append(_Finding(f"the calibration cannot be used: {error}", True))
            pairs = ()
    matched = [_match(pair, rectification) for pair in pairs]
    clean = [without_mistakes(m, flat) for m in matched]
    every = RowMatches(
        np.concatenate([np.zeros((0, 2)), *(m.left_px for m in clean)]),
        np.concatenate([np.zeros((0, 2)), *(m.right_px for m in clean)]),
    )
    size = pairs[0][0].shape[1::-1] if len(pairs) else (1, 1)
    size = rectification.size if rectification is not None else size
    fits = _fits(every, flat, size)
    findings += [
        *_order(matched, pairs, rectification),
        *(_rows(every, fits, len(pairs)) + _steadiness(clean, flat, size)),
        *(_units(flat, every) if flat is not None else ()),
    ]
    offset = every.vertical_px
    enough = len(every) >= LEAST_FOR_TREND
    return Diagnosis(
        tuple(f.words for f in findings if f.is_problem),
        tuple(f.words for f in findings if not f.is_problem),
        len(every),
        float(np.median(np.abs(offset))) if enough else np.nan,
        float(np.percentile(np.abs(offset), 95)) if enough else np.nan,
        float(np.median(offset)) if enough else np.nan,
        _ninths(every, size),
        fits[0],
        fits[1],
        _cause(every, fits),
        () if flat is None else _expectations(flat, rig, rectification),
    )


def _match(pair: tuple[np.ndarray, np.ndarray], rectification: Rectification | None) -> RowMatches:
    gray = []
    for image in pair:
        array = np.ascontiguousarray(image)
        gray.append(cv2.cvtColor(array, cv2.COLOR_RGB2GRAY) if array.ndim == 3 else array)
    if rectification is not None:
        gray = list(rectification.apply(gray[0], gray[1]))
    elif gray[0].shape != gray[1].shape:
        raise ShapeError(
            f"left is {_size(gray[0])} pixels and right {_size(gray[1])}: the images of a rectified pair must have the same size"
        )
    found = match_features(gray[0], gray[1])
    if rectification is None or not len(found):
        return found
    inside = np.ones(len(found), bool)
    for pixels, valid in (
        (found.left_px, rectification.left_valid),
        (found.right_px, rectification.right_valid),
    ):
        column, row = np.rint(pixels).astype(int).T
        height, width = valid.shape
        inside &= valid[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return RowMatches(found.left_px[inside], found.right_px[inside])


def _size(gray: np.ndarray) -> str:
    return f"{gray.shape[1]} x {gray.shape[0]}"


def _fits(matches: RowMatches, flat: RectifiedRig | None, size: tuple[int, int]) -> tuple[float, float]:
    if len(matches) < LEAST_FOR_TREND:
        return np.nan, np.nan
    rig, camera = row_basis(matches, flat, size)
    return fit_trend(matches.vertical_px, rig).rms_px, fit_trend(matches.vertical_px, camera).rms_px


def _rms(matches: RowMatches) -> float:
    return 1.4826 * float(np.median(np.abs(matches.vertical_px)))


def _cause(matches: RowMatches, fits: tuple[float, float]) -> Cause:
    if len(matches) < LEAST_FOR_TREND:
        return Cause.UNKNOWN
    offset = np.abs(matches.vertical_px)
    if np.percentile(offset, 95) <= GOOD_PX or (
        _rms(matches) <= GOOD_PX and fits[1] > _EXPLAINS * _rms(matches)
    ):
        return Cause.NONE
    if fits[1] < _LESS * fits[0] and fits[0] - fits[1] > 0.5 * (_rms(matches) - fits[0]):
        return Cause.DISTORTION
    if fits[0] < _EXPLAINS * _rms(matches):
        return Cause.EXTRINSICS
    return Cause.UNCLEAR


def _order(
    matched: Sequence[RowMatches],
    pairs: Sequence[tuple[np.ndarray, np.ndarray]],
    rectification: Rectification | None,
) -> list[_Finding]:
    if matched and all(is_swapped(m) for m in matched):
        return [_Finding("left and right are swapped: features are farther right in the right image", True)]
    if rectification is None or not matched or _off_px(matched[0]) <= BAD_PX:
        return []
    left, right = pairs[0]
    if left.shape != right.shape or not _off_px(_match((right, left), rectification)) <= GOOD_PX:
        return []
    return [
        _Finding("left and right are swapped: when exchanged, their rows match with this calibration", True)
    ]


def _off_px(matches: RowMatches) -> float:
    """Median vertical offset; infinite if there are too few matches."""
    return float(np.median(np.abs(matches.vertical_px))) if len(matches) >= LEAST_FOR_TREND else np.inf


def _rows(matches: RowMatches, fits: tuple[float, float], num_pairs: int) -> list[_Finding]:
    if not num_pairs:
        return []
    if len(matches) < LEAST_FOR_TREND:
        found = f"{len(matches)} {'feature matches' if len(matches) == 1 else 'features match'}"
        words = f"{found}, too few for a diagnosis: the images are blank, blurred or of different scenes"
        return [_Finding(words, True)]
    if np.median(np.hypot(matches.disparity_px, matches.vertical_px)) < SAME_PX:
        return [_Finding("left and right are the same image", True)]
    cause = _cause(matches, fits)
    if cause is Cause.NONE:
        return []
    offset = np.abs(matches.vertical_px)
    words = f"rows are misaligned by {np.median(offset):.2f} px (median), {np.percentile(offset, 95):.2f} px (95 %); likely cause: {cause}"
    is_bad = np.median(offset) > GOOD_PX or np.percentile(offset, 95) > 2.0 * BAD_PX
    return [_Finding(words, is_bad)]


def _steadiness(
    clean: Sequence[RowMatches], flat: RectifiedRig | None, size: tuple[int, int]
) -> list[_Finding]:
    """Check that the row trend is the same in every pair, as with a rigid, synchronized rig."""
    good = [m for m in clean if len(m) >= LEAST_FOR_TREND]
    if len(good) < 2:
        words = "checking the synchronization needs several pairs taken while the rig moves"
        return [_Finding(words, False)]
    trends = [fit_trend(m.vertical_px, row_basis(m, flat, size)[0][:, :3]) for m in good]
    offset = np.array([t.coefficients[0] for t in trends])
    sigma = np.array([t.sigma[0] for t in trends])
    spread = float(np.std(offset, ddof=1))
    if spread <= max(_UNSTEADY_PX, _UNSTEADY_SIGMAS * float(np.median(sigma))):
        return []
    words = f"the vertical offset differs from pair to pair by {spread:.2f} px: the cameras are not synchronous, or the rig bends"
    return [_Finding(words, True)]


def _units(flat: RectifiedRig, matches: RowMatches) -> list[_Finding]:
    out = []
    if flat.baseline > _LARGE_BASELINE:
        words = f"the baseline is {flat.baseline:g}: if this is in millimeters, so are the depths; in meters it would be very long"
        out.append(_Finding(words, False))
    if flat.baseline < _SMALL_BASELINE:
        out.append(
            _Finding(f"the baseline is {flat.baseline:g}: too short for meters; is its unit wrong?", True)
        )
    shifted = matches.disparity_px + flat.principal_offset_px
    if len(matches) >= LEAST_FOR_TREND and np.median(shifted) > 0.5:
        depth = flat.focal_px * flat.baseline / np.median(shifted)
        words = f"half of the features are nearer than {depth:.3g} (in the baseline's unit): is that plausible for the scene?"
        out.append(_Finding(words, False))
    return out


def _ninths(matches: RowMatches, size: tuple[int, int]) -> Float64[np.ndarray, "3 3"]:
    out = np.full((_GRID, _GRID), np.nan)
    if not len(matches):
        return out
    column = np.clip((matches.left_px[:, 0] / size[0] * _GRID).astype(int), 0, _GRID - 1)
    row = np.clip((matches.left_px[:, 1] / size[1] * _GRID).astype(int), 0, _GRID - 1)
    for r in range(_GRID):
        for c in range(_GRID):
            own = matches.vertical_px[(row == r) & (column == c)]
            out[r, c] = np.median(own) if len(own) >= 3 else np.nan
    return out


def _expectations(
    flat: RectifiedRig, rig: StereoRig | RectifiedRig | None, rectification: Rectification | None
) -> tuple[DepthExpectation, ...]:
    out = []
    for depth in flat.round_ranges():
        disparity = flat.focal_px * flat.baseline / depth - flat.principal_offset_px
        scale = depth**2 / (flat.focal_px * flat.baseline)
        wrong = np.nan
        if isinstance(rig, StereoRig) and rig.covariance is not None and rectification is not None:
            width, height = rectification.size
            one = np.full((height, width), np.nan)
            one[height // 2, width // 2] = disparity
            wrong = float(calibration_sigma(rig, rectification, one)[height // 2, width // 2])
        out.append(DepthExpectation(depth, disparity, scale * TYPICAL_SIGMA_PX, scale * wrong))
    return tuple(out)
