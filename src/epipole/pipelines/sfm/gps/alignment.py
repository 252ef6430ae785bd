"""Similarity that aligns a model with the GPS positions of its images.

GPS determines scale, heading and position and, unless the images lie on a line, also the up direction. The cameras
suggest up directions, each with an uncertainty. A least-squares fit weighs them against the positions:

    min over (s, R, t) of  sum_i rho(|s R c_i + t - g_i|^2 / sigma^2)  +  min_k angle(R up_k, z)^2 / sigma_k^2

with Cauchy's rho, applied separately to horizontal and vertical residuals. So the cameras determine what GPS cannot,
and do not override GPS where it can.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from epipole.config import RansacConfig
from epipole.geometry import Rotation3, Similarity3
from epipole.pipelines.sfm.gps.evidence import GpsEvidence, gps_evidence
from epipole.pipelines.sfm.up_direction import UpDirection
from epipole.robust import estimate_similarity, estimate_upright_similarity

MIN_POSITIONS = 3
"""Two positions give scale, heading and translation; a third checks them."""
VERTICAL_TO_HORIZONTAL = 2.0
"""Ratio of the standard deviations of altitude and of a horizontal coordinate."""
MAX_PRIOR_DEVIATIONS = 3.0
"""Up directions that deviate by more standard deviations have no further influence."""
TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution, divided by its median absolute deviation."""
Z_AXIS = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class GpsAlignment:
    """Alignment of a model with the GPS positions of its images."""

    enu_from_world: Similarity3
    residuals_m: np.ndarray
    """(n,) distance of each image from its GPS position, horizontal if the altitude is unknown; NaN without GPS."""
    up_sigma_rad: float
    """Standard deviation of the up direction, from positions and cameras together."""

    @property
    def median_m(self) -> float:
        """Median residual."""
        return float(np.nanmedian(self.residuals_m))


def align_to_gps(
    centers_in_world: np.ndarray,
    up_directions: Sequence[UpDirection],
    positions_enu: np.ndarray,
    sigma_m: float,
    max_error_m: float,
    seed: int = 0,
) -> GpsAlignment | None:
    """Align a model with the GPS positions of its images; None if they do not determine the similarity.

    None also if the positions would fit any model equally well (`gps_evidence`).

    Args:
        centers_in_world: (n, 3) camera centers, NaN rows for images without a pose.
        up_directions: possible up directions, most likely first.
        positions_enu: (n, 3) meters east, north, up; NaN rows without GPS, NaN up if the altitude is unknown.
        sigma_m: standard deviation of a horizontal coordinate; increased if the residuals are larger.
        max_error_m: distance beyond which positions are outliers.
        seed: random seed.
    """
    usable = np.flatnonzero(
        np.isfinite(positions_enu[:, :2]).all(axis=1) & np.isfinite(centers_in_world).all(axis=1)
    )
    if not is_wide_enough(positions_enu[usable], max_error_m):
        return None
    if not evidence_of(centers_in_world, up_directions, positions_enu, seed).is_convincing:
        return None
    source, target = centers_in_world[usable], positions_enu[usable]
    found: list[tuple[float, float, Similarity3]] = []
    for start in _starts(source, target, up_directions, max_error_m, seed):
        refined = _refine(start, source, target, up_directions, sigma_m)
        if refined is not None:
            near = _without_outliers(refined[2].apply(source) - target, target, max_error_m)
            again = _refine(refined[2], source, near, up_directions, sigma_m)
            found.append(refined if again is None else (refined[0], again[1], again[2]))
    if not found:
        return None
    _, up_sigma_rad, enu_from_world = min(found, key=lambda f: f[0])
    residuals_m = gps_distances(enu_from_world.apply(centers_in_world), positions_enu)
    return GpsAlignment(enu_from_world, residuals_m, up_sigma_rad)


def gps_distances(centers_enu: np.ndarray, positions_enu: np.ndarray) -> np.ndarray:
    """(n,) distance of each camera from its GPS position, horizontal if the altitude is unknown; NaN without GPS."""
    off = centers_enu - positions_enu
    off[~np.isfinite(positions_enu[:, 2]) & np.isfinite(off[:, 0]), 2] = 0.0
    return np.linalg.norm(off, axis=1)


def evidence_of(
    centers_in_world: np.ndarray, up_directions: Sequence[UpDirection], positions_enu: np.ndarray, seed: int
) -> GpsEvidence:
    """How well the positions fit the model, for any of the up directions."""
    return gps_evidence(centers_in_world, positions_enu, [up.direction for up in up_directions], seed)


def is_wide_enough(positions_enu: np.ndarray, max_error_m: float) -> bool:
    """Whether there are enough positions, and their spread exceeds their error; robust against a few gross errors."""
    if len(positions_enu) < MIN_POSITIONS:
        return False
    offsets = positions_enu[:, :2] - np.median(positions_enu[:, :2], axis=0)
    nearer = offsets[np.argsort(np.linalg.norm(offsets, axis=1))[: max(MIN_POSITIONS, 3 * len(offsets) // 4)]]
    return bool(np.linalg.norm(np.ptp(nearer, axis=0)) >= max_error_m)


def _starts(
    source: np.ndarray,
    target: np.ndarray,
    up_directions: Sequence[UpDirection],
    max_error_m: float,
    seed: int,
) -> list[Similarity3]:
    """Robust similarities to start from: one per up direction, and one in 3D without an up direction."""
    config = RansacConfig(max_error_px=max_error_m, min_inliers=2, min_inlier_ratio=0.0, seed=seed)
    has_altitude = np.isfinite(target[:, 2])
    flat = np.where(has_altitude[:, None], target, target * [1, 1, 0])
    flat[~has_altitude, 2] = np.median(target[has_altitude, 2]) if has_altitude.any() else 0.0
    out = []
    for up in up_directions:
        upright = Similarity3(
            np.asarray(1.0), Rotation3.from_two_vectors(up.direction, Z_AXIS).matrix, np.zeros(3)
        )
        fitted = estimate_upright_similarity(upright.apply(source), flat, config)
        if np.isfinite(fitted.score):
            out.append(fitted.model @ upright)
    if has_altitude.sum() >= 4:
        spatial = estimate_similarity(source[has_altitude], target[has_altitude], config)
        if np.isfinite(spatial.score):
            out.append(spatial.model)
    return out


def _refine(
    start: Similarity3,
    source: np.ndarray,
    target: np.ndarray,
    up_directions: Sequence[UpDirection],
    sigma_m: float,
) -> tuple[float, float, Similarity3] | None:
    """Cost, standard deviation of up, and refined similarity; None if the model collapses to a point."""
    from scipy.optimize import least_squares  # slow to import, and needed for GPS only

    has_value = np.isfinite(target)
    goal, middle = np.where(has_value, target, 0.0), source.mean(axis=0)
    sigma = _sigma_of(start.apply(source) - target, sigma_m)
    prior, penalty = _prior_of(start, up_directions)

    def moved(x: np.ndarray) -> Similarity3:
        scale, rotation = float(start.scale) * np.exp(x[0]), Rotation3.exp(x[1:4]).matrix @ start.rotation
        at = start.apply(middle[None])[0] + x[4:]
        return Similarity3(np.asarray(scale), rotation, at - scale * rotation @ middle)

    def residuals(x: np.ndarray) -> np.ndarray:
        off = np.where(has_value, (moved(x).apply(source) - goal) / sigma, 0.0)
        tilt = np.zeros(0)
        if prior is not None:
            tilt = (moved(x).rotation @ prior.direction - Z_AXIS) / prior.sigma_rad
        return np.concatenate([_robust(off[:, :2]).ravel(), _robust(off[:, 2:]).ravel(), tilt])

    found = least_squares(residuals, np.zeros(7), x_scale=np.repeat([1.0, 1.0, sigma[0]], [1, 3, 3]))
    result = moved(found.x)
    reach_m = float(result.scale) * float(np.linalg.norm(source - middle, axis=1).max())
    if not np.isfinite(found.cost) or reach_m <= sigma[0]:
        return None
    return float(found.cost) + penalty, _tilt_sigma_rad(found.jac), result


def _without_outliers(off: np.ndarray, target: np.ndarray, max_error_m: float) -> np.ndarray:
    """Positions with NaN for horizontal outliers and for outlying altitudes."""
    flat, high = np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])
    limit_m = max(max_error_m, 3.0 * _median(flat))
    near = np.where((flat <= limit_m)[:, None], target, np.nan)
    near[high > max(VERTICAL_TO_HORIZONTAL * limit_m, 3.0 * _median(high)), 2] = np.nan
    return near


def _sigma_of(off: np.ndarray, sigma_m: float) -> np.ndarray:
    """(3,) standard deviations: the given one, or a larger one if the residuals of a first fit show it."""
    horizontal = max(sigma_m, TO_SIGMA * _median(np.abs(off[:, :2])))
    vertical = max(VERTICAL_TO_HORIZONTAL * sigma_m, TO_SIGMA * _median(np.abs(off[:, 2])))
    return np.array([horizontal, horizontal, vertical])


def _median(values: np.ndarray) -> float:
    """Median of the finite values; 0 if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else 0.0


def _robust(whitened: np.ndarray) -> np.ndarray:
    """Vectors (n, d) whose squared norms are Cauchy's loss log(1 + r^2) of the given ones."""
    squared = (whitened**2).sum(axis=1, keepdims=True)
    return whitened * np.sqrt(np.where(squared > 1e-12, np.log1p(squared) / np.maximum(squared, 1e-12), 1.0))


def _prior_of(start: Similarity3, up_directions: Sequence[UpDirection]) -> tuple[UpDirection | None, float]:
    """Up direction nearest to a start, or None if all deviate too much, and its cost."""
    best, least = None, MAX_PRIOR_DEVIATIONS
    for up in up_directions:
        angle = float(np.arccos(np.clip((start.rotation @ up.direction)[2], -1.0, 1.0)))
        if angle / up.sigma_rad < least:
            best, least = up, angle / up.sigma_rad
    return best, 0.5 * MAX_PRIOR_DEVIATIONS**2 if best is None else 0.0


def _tilt_sigma_rad(jacobian: np.ndarray) -> float:
    """Standard deviation of the least certain tilt, marginalized over all other unknowns."""
    information = jacobian.T @ jacobian
    tilts, others = [1, 2], [0, 3, 4, 5, 6]
    shared = information[np.ix_(tilts, others)]
    own = (
        information[np.ix_(tilts, tilts)]
        - shared @ np.linalg.pinv(information[np.ix_(others, others)], rcond=1e-9, hermitian=True) @ shared.T
    )
    weakest = float(np.linalg.eigvalsh(own)[0])
    return float(1.0 / np.sqrt(weakest)) if weakest > 0 else float("inf")
