"""The world frame of a finished model: upright, near the origin, in metres where GPS allows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from epipole.config import RansacConfig
from epipole.errors import DegenerateGeometryError
from epipole.geometry import Rigid3, Rotation3, Similarity3, align_points
from epipole.pipelines.sfm.gps_evidence import gps_evidence
from epipole.robust import estimate_upright_similarity

MIN_FIXES = 3
"""Two positions give scale, heading and translation; a third checks them."""


@dataclass(frozen=True, slots=True, eq=False)
class GpsAlignment:
    """How a model fits the GPS places of its images."""

    enu_from_world: Similarity3
    residuals_m: np.ndarray
    """Distance of each image from its fix; NaN where there is none."""

    @property
    def median_m(self) -> float:
        """Median residual."""
        return float(np.nanmedian(self.residuals_m))


def upright_from_world(cams_from_world: Rigid3, points_in_world: np.ndarray) -> Similarity3:
    """Turn the model so that +z is up, centre it, and scale its points to a median distance of one.

    Photographers hold cameras level: the direction to which all x axes are most nearly orthogonal is up
    (Szeliski 2006); its sign, and the direction itself where the x axes do not span a plane, come from the y axes.
    """
    x_axes, y_axes = cams_from_world.rotation[:, 0], cams_from_world.rotation[:, 1]
    up = -y_axes.mean(axis=0)
    values, vectors = np.linalg.eigh(x_axes.T @ x_axes / len(x_axes))
    candidate = vectors[:, 0] * np.sign(vectors[:, 0] @ up or 1.0)
    size = np.linalg.norm(up)
    # Trust the x axes when they turn enough and agree with the y axes.
    if values[1] > 0.05 and size > 0 and candidate @ up / size > 0.7:
        up = candidate
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 0 else np.array([0.0, 0.0, 1.0])
    rotation = Rotation3.from_two_vectors(up, np.array([0.0, 0.0, 1.0])).matrix
    centers = cams_from_world.centers()
    middle = np.median(points_in_world, axis=0) if len(points_in_world) else centers.mean(axis=0)
    reach = (
        float(np.median(np.linalg.norm(points_in_world - middle, axis=1))) if len(points_in_world) else 1.0
    )
    scale = 1.0 / reach if reach > 0 else 1.0
    return Similarity3(np.asarray(scale), rotation, -scale * rotation @ middle)


def align_to_gps(
    centers_in_world: np.ndarray,
    upright: Similarity3,
    positions_enu: np.ndarray,
    max_error_m: float,
    seed: int = 0,
) -> GpsAlignment | None:
    """The similarity from the model to the GPS positions of its cameras; None where they do not determine it.

    None also where positions like these would fit any model as well (`gps_evidence`).

    Robust over samples of two images (the model is upright already, so that two fixes give scale, heading and
    place), refined on the agreeing ones: with the full similarity where the path spans a plane, else upright.

    Args:
        centers_in_world: (n, 3).
        upright: from `upright_from_world`.
        positions_enu: fixes in local metres, NaN rows for none.
        max_error_m: fixes farther off are outliers.
        seed: of the sampling.
    """
    usable = np.flatnonzero(
        np.isfinite(positions_enu).all(axis=1) & np.isfinite(centers_in_world).all(axis=1)
    )
    if len(usable) < MIN_FIXES:
        return None
    source, target = upright.apply(centers_in_world[usable]), positions_enu[usable]
    if np.linalg.norm(np.ptp(target[:, :2], axis=0)) < max_error_m:
        return None
    if not gps_evidence(source, target, seed).is_convincing:
        return None
    config = RansacConfig(max_error_px=max_error_m, min_inliers=2, min_inlier_ratio=0.0, seed=seed)
    found = estimate_upright_similarity(source, target, config)
    if not np.isfinite(found.score):
        return None
    enu_from_upright = found.model
    for _ in range(10):
        errors = np.linalg.norm(enu_from_upright.apply(source) - target, axis=1)
        near = errors <= max(max_error_m, 1.5 * float(np.median(errors)))
        refined = _refit(source[near], target[near])
        if refined is None:
            break
        enu_from_upright = refined
    enu_from_world = enu_from_upright @ upright
    residuals = np.linalg.norm(enu_from_world.apply(centers_in_world) - positions_enu, axis=1)
    return GpsAlignment(enu_from_world, residuals)


def _refit(source: np.ndarray, target: np.ndarray) -> Similarity3 | None:
    if len(source) < 3:
        return None
    flat = np.linalg.svd(source - source.mean(axis=0), compute_uv=False)
    if flat[1] > 0.2 * flat[0]:
        try:
            return align_points(source, target)
        except DegenerateGeometryError:
            return None
    return _upright_similarity(source, target)


def _upright_similarity(source: np.ndarray, target: np.ndarray) -> Similarity3 | None:
    """Scale, heading and translation: least squares in the horizontal plane (complex numbers), z shifted."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    p, q = a[:, 0] + 1j * a[:, 1], b[:, 0] + 1j * b[:, 1]
    size = float((np.abs(p) ** 2).sum())
    if size <= 1e-12:
        return None
    turn = (np.conj(p) * q).sum() / size
    scale = float(np.abs(turn))
    if scale <= 1e-12:
        return None
    rotation = Rotation3.exp(np.array([0.0, 0.0, float(np.angle(turn))])).matrix
    return Similarity3(
        np.asarray(scale), rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0)
    )
