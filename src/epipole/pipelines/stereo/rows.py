"""Row alignment of a rectified pair: vertical offsets of features, their trend, and the order of the images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from epipole.config import FeatureConfig
from epipole.features import detect_features, match_descriptors
from epipole.scene import RectifiedRig

_MOST_OFFSET = 0.1  # of the image's height: matches with larger vertical offsets are wrong
_ROUNDS = 20
LEAST_FOR_TREND = 50
_KEPT = 3.0  # robust standard deviations: matches farther from the trend are outliers
SAME_PX = 0.02
"""Median feature motion below which both images are the same."""
_LEAST_MATCHES = 30
_SPARSE, _FEW = 0.3, 0.2
_AGREES_PX, _MOST_BEYOND = 2.0, 0.1
_NEAR_PX = 1.0  # smaller disparities do not indicate the order of the images
_SWAPPED_FRACTION = 0.8
_MOST_OFF_PX = 1.0
"""Median vertical offset beyond which row-wise matching fails."""


@dataclass(frozen=True, slots=True, eq=False)
class RowMatches:
    """Feature matches of a pair."""

    left_px: Float64[np.ndarray, "n 2"]
    right_px: Float64[np.ndarray, "n 2"]
    num_features: int = 0
    """Number of features in the image with fewer."""

    @property
    def vertical_px(self) -> Float64[np.ndarray, " n"]:
        """y_right - y_left: zero in a rectified pair."""
        return self.right_px[:, 1] - self.left_px[:, 1]

    @property
    def disparity_px(self) -> Float64[np.ndarray, " n"]:
        """x_left - x_right."""
        return self.left_px[:, 0] - self.right_px[:, 0]

    def __len__(self) -> int:
        return len(self.left_px)

    def __repr__(self) -> str:
        return f"RowMatches({len(self)})"


@dataclass(frozen=True, slots=True, eq=False)
class RowTrend:
    """Vertical offsets as a smooth function of the image position, as caused by a wrong calibration."""

    coefficients: Float64[np.ndarray, " p"]
    sigma: Float64[np.ndarray, " p"]
    rms_px: float
    """Robust standard deviation of the offsets from the trend."""


def match_features(
    left: UInt8[np.ndarray, "h w"], right: UInt8[np.ndarray, "h w"], kind: Literal["sift", "orb"] = "sift"
) -> RowMatches:
    """Mutual matches by the ratio test with a vertical offset below a tenth of the image height.

    Args:
        left: gray.
        right: gray, the same size.
        kind: SIFT is accurate to 0.2 pixels; ORB to 1 pixel, and needs no compiled kernels.
    """
    config = FeatureConfig(kind=kind, max_features=4000 if kind == "sift" else 2000)
    one, two = detect_features(left, config), detect_features(right, config)
    pairs = match_descriptors(one.descriptors, two.descriptors)
    first, second = one.pixels[pairs[:, 0]].astype(np.float64), two.pixels[pairs[:, 1]].astype(np.float64)
    offset = second[:, 1] - first[:, 1]
    near = np.abs(offset) < _MOST_OFFSET * left.shape[0]
    return RowMatches(first[near], second[near], min(len(one), len(two)))


@dataclass(frozen=True, slots=True)
class MatchedPair:
    """Search range and density of a matched pair."""

    density: float
    """Fraction of the pixels with a disparity."""
    search_px: tuple[float, float]
    """Smallest and largest disparity searched; infinite if determined from the images."""
    is_calibrated: bool


def quick_warnings(left_rgb: np.ndarray, right_rgb: np.ndarray, found: MatchedPair) -> tuple[str, ...]:
    """Warnings about obvious problems of a rectified pair: swapped, misaligned rows, too small a range, nothing in common.

    Args:
        left_rgb: (h, w, 3).
        right_rgb: the same size.
        found: search range and result.
    """
    gray = [cv2.cvtColor(np.ascontiguousarray(p), cv2.COLOR_RGB2GRAY) for p in (left_rgb, right_rgb)]
    matches = match_features(gray[0], gray[1], "orb")
    if len(matches) and np.median(np.abs(matches.vertical_px)) > _MOST_OFF_PX:
        # Either rows are misaligned or most matches are wrong (e.g. on a chessboard): decide with better features.
        matches = without_mistakes(match_features(gray[0], gray[1]), None)
    few = f"only {100 * found.density:.1f} % of the pixels are known"
    if len(matches) < _LEAST_MATCHES:
        if found.density > _SPARSE:
            return ()
        if matches.num_features < _LEAST_MATCHES:
            return (f"{few}: the images are blank, dark or blurred",)
        return (
            f"{few}, and hardly any feature of one image is found in the other: do they show the same scene?",
        )
    if np.median(np.hypot(matches.disparity_px, matches.vertical_px)) < SAME_PX:
        return ("left and right are the same image, which gives no depth",)
    out = []
    low, high = found.search_px
    span = f"from {low:g} px on" if np.isinf(high) else f"{low:g} to {high:g} px"
    agrees = np.abs(matches.vertical_px - np.median(matches.vertical_px)) < _AGREES_PX
    beyond = (matches.disparity_px < low - _NEAR_PX) | (matches.disparity_px > high + _NEAR_PX)
    if low >= 0 and is_swapped(matches):
        where = "nearly all features are farther right in the right image"
        out.append(
            f"the calibration seems to be of another pair, or left and right are swapped: {where}"
            if found.is_calibrated
            else f"left and right look swapped: {where}. Swap the two images"
        )
    elif agrees.any() and beyond[agrees].mean() > _MOST_BEYOND:
        out.append(
            f"{100 * beyond[agrees].mean():.0f} % of the features have disparities outside the search range, {span}: "
            "disparities found there are wrong"
        )
    offset = float(np.median(np.abs(matches.vertical_px)))
    if offset > _MOST_OFF_PX:
        advice = (
            "the calibration does not fit these images" if found.is_calibrated else "pass its calibration"
        )
        out.append(
            f"the pair is not rectified: features are {offset:.1f} px off their rows (median); {advice}. "
            "`epipole stereo doctor` gives details"
        )
    if found.density < _FEW and not out:
        out.append(few)
    return tuple(out)


def is_swapped(matches: RowMatches) -> bool:
    """Whether nearly all significant disparities are negative."""
    telling = np.abs(matches.disparity_px) > _NEAR_PX
    if telling.sum() < _LEAST_MATCHES:
        return False
    # Up to half of the matches may be wrong: use the sign of those with consistent rows.
    agrees = telling & (np.abs(matches.vertical_px - np.median(matches.vertical_px)) < _AGREES_PX)
    return bool(agrees.any() and (matches.disparity_px[agrees] < 0).mean() > _SWAPPED_FRACTION)


def fit_trend(offsets: Float64[np.ndarray, " n"], basis: Float64[np.ndarray, "n p"]) -> RowTrend:
    """Least squares with Cauchy weights, scaled by the median absolute deviation."""
    coefficients = np.zeros(basis.shape[1])
    coefficients[0] = np.median(offsets)
    scale = 1.0
    for _ in range(_ROUNDS):
        residual = offsets - basis @ coefficients
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-3)
        weight = 1.0 / (1.0 + (residual / (2.0 * scale)) ** 2)
        root = np.sqrt(weight)[:, None]
        coefficients = np.linalg.lstsq(root * basis, root[:, 0] * offsets, rcond=None)[0]
    inside = np.abs(offsets - basis @ coefficients) < 3.0 * scale
    information = basis[inside].T @ basis[inside]
    sigma = scale * np.sqrt(np.maximum(np.diag(np.linalg.pinv(information)), 0.0))
    return RowTrend(coefficients, sigma, scale)


def row_basis(
    matches: RowMatches, flat: RectifiedRig | None, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Basis functions of the vertical offsets caused by small errors of the rig; and with those of distortion appended.

    With x, y relative to the principal point and divided by f: pitch 1 + y^2, yaw x y, roll x, scale y; baseline direction d and y d;
    radial distortion y r^2 and y r^4 in one camera, x y d in both alike.
    """
    focal, cx, cy = (flat.focal_px, flat.cx, flat.cy) if flat else (size[0], size[0] / 2, size[1] / 2)
    x, y = (matches.right_px[:, 0] - cx) / focal, (matches.right_px[:, 1] - cy) / focal
    d = matches.disparity_px / focal
    r2 = x * x + y * y
    rig = np.stack([np.ones_like(x), x, y, x * y, y * y, d, y * d], axis=1)
    return rig, np.concatenate([rig, np.stack([y * r2, y * r2 * r2, x * y * d], axis=1)], axis=1)


def without_mistakes(matches: RowMatches, flat: RectifiedRig | None) -> RowMatches:
    """Matches within three robust standard deviations of the trend from rig and distortion errors; all matches if there are few."""
    if len(matches) < LEAST_FOR_TREND:
        return matches
    extent = np.maximum(matches.left_px.max(axis=0), matches.right_px.max(axis=0))
    basis = row_basis(matches, flat, (int(extent[0]) + 1, int(extent[1]) + 1))[1]
    middle = np.median(matches.vertical_px)
    near = np.abs(matches.vertical_px - middle) < np.maximum(
        10.0, 5.0 * np.median(np.abs(matches.vertical_px - middle))
    )
    if near.sum() < LEAST_FOR_TREND:
        return matches
    trend = fit_trend(matches.vertical_px[near], basis[near])
    good = np.abs(matches.vertical_px - basis @ trend.coefficients) < _KEPT * max(trend.rms_px, 0.1)
    return RowMatches(matches.left_px[good], matches.right_px[good], matches.num_features)
