"""How well places are known in the map's world: the map's own error, and that of the frame before the map.

Cameras that tell depth alone: of one camera the scale is open, and its frames tell their own part only.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from epipole.errors import DegenerateGeometryError
from epipole.geometry import Rigid3
from epipole.mapping import RefinedPose
from epipole.optim import BundleConfig, BundleProblem, BundleResult, bundle_covariance
from epipole.pipelines.slam.slam_map import Keyframe, SlamMap

MEDIAN_SQ = 1.386
"""Median of the squared length of a plane vector whose coordinates have deviation one."""
LEAST_NOISE_PX = 0.05
MOST_CORRELATED = 0.9
USUAL, PAIRS, LEAST_SEEN = 0.5, 200, 10
"""The correlation that is assumed, how many pairs of residuals it is worth, and observations of points that tell another."""


def own_covariance(refined: RefinedPose, model: SlamMap, number: int) -> np.ndarray:
    """(6, 6) of a frame's place before the map: none where it has become a keyframe, which knows its own.

    Where the map knows its error the noise is that which the frame's own errors show, else a pixel.

    Args:
        refined: the frame's place.
        model: the map.
        number: of the frame.
    """
    newest = next((k for k in reversed(model.keyframes) if len(k.point)), None)
    if newest is None or not any(k.covariance.any() for k in (newest, *model.keyframes[-3:])):
        return refined.covariance()
    if newest.number == number and newest.covariance.any():
        return np.zeros((6, 6))
    return _by_own_noise(refined)


def carry_covariance(model: SlamMap, refined: RefinedPose) -> None:
    """Give the newest keyframe the covariance of the one before, carried along, and its own part, until an adjustment knows."""
    before, newest = model.keyframes[-2:]
    if before.covariance.any():
        between = newest.cam_from_world @ before.cam_from_world.inverse()
        newest.covariance = with_map_error(before.covariance, between, _by_own_noise(refined))


def _by_own_noise(refined: RefinedPose) -> np.ndarray:
    errors = refined.error_sq[np.isfinite(refined.error_sq)]
    noise_sq = float(np.median(errors)) / MEDIAN_SQ if len(errors) else 1.0
    return refined.covariance() * max(noise_sq, LEAST_NOISE_PX**2)


def with_map_error(
    keyframe_covariance: np.ndarray, cam_from_keyframe: Rigid3, covariance: np.ndarray
) -> np.ndarray:
    """(..., 6, 6) of places told from keyframes: Ad C_keyframe Ad^T, and their own part.

    Args:
        keyframe_covariance: (..., 6, 6).
        cam_from_keyframe: batch shape (...).
        covariance: (..., 6, 6) of cam_from_keyframe; may be infinite.
    """
    adjoint = cam_from_keyframe.adjoint()
    return adjoint @ keyframe_covariance @ np.swapaxes(adjoint, -1, -2) + covariance


def learn_covariances(
    keyframes: Sequence[Keyframe],
    num_free: int,
    problem: BundleProblem,
    result: BundleResult,
    config: BundleConfig,
) -> None:
    """Give the adjusted keyframes the covariances of their places in the world.

    What the adjustment tells given the held keyframes, plus the covariance of the newest held one, carried along rigidly.
    The noise is that of the residuals. A point's error goes on from keyframe to keyframe, so that many of them tell less than
    as many independent ones: with the correlation rho of one with the next the variance is (1 + rho) / (1 - rho) times as
    large (Bartlett, On the theoretical specification and sampling properties of autocorrelated time-series, 1946).

    Args:
        keyframes: those of the problem's frames, in their order.
        num_free: how many of the first were adjusted.
        problem: what was adjusted.
        result: its minimum.
        config: the loss that was minimised.
    """
    try:
        found = bundle_covariance(problem, result, config)
    except DegenerateGeometryError:
        return
    times = np.array([k.number for k in keyframes])
    rho = residual_correlation(problem, result, times, found.noise_px)
    own = found.rig_from_world * (1.0 + rho) / (1.0 - rho)
    held = [k for k in range(num_free, len(keyframes)) if keyframes[k].covariance.any()]
    for k in range(num_free):
        covariance = own[k] if np.isfinite(own[k]).all() else np.full((6, 6), np.inf)
        if held:
            near = keyframes[max(held, key=lambda n: times[n])]
            between = result.rig_from_world[k] @ near.cam_from_world.inverse()
            covariance = with_map_error(near.covariance, between, covariance)
        if np.isfinite(covariance).all():
            keyframes[k].covariance = covariance


def residual_correlation(
    problem: BundleProblem, result: BundleResult, times: np.ndarray, noise_px: float
) -> float:
    """Correlation of a point's residual in a keyframe with that in the next one that sees it; 0 to `MOST_CORRELATED`.

    Args:
        problem: what was adjusted.
        result: its minimum.
        times: (f,) of the frames, for their order.
        noise_px: standard deviation of a coordinate; residuals beyond three of them do not count.
    """
    point = np.repeat(np.arange(len(problem.points_in_world)), np.diff(problem.offsets))
    focal, middle = problem.camera_params[problem.camera, 0], result.camera_params[problem.camera, 2:4]
    cams = (problem.cam_from_rig[problem.sensor]) @ result.rig_from_world[problem.frame]
    in_cam = np.einsum("kij,kj->ki", cams.rotation, result.points_in_world[point]) + cams.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        off = focal[:, None] * in_cam[:, :2] / in_cam[:, 2:] + middle - problem.pixels
    off = np.where(
        (np.diff(problem.offsets) >= LEAST_SEEN)[point][:, None], off, np.nan
    )  # fitting fewer hides it
    order = np.lexsort((times[problem.frame], problem.sensor, point))
    same = (np.diff(point[order]) == 0) & (np.diff(problem.sensor[order]) == 0)
    now, then = off[order][1:][same], off[order][:-1][same]
    good = (np.abs(now) < 3.0 * noise_px).all(axis=1) & (np.abs(then) < 3.0 * noise_px).all(axis=1)
    now, then = now[good], then[good]
    size = float((now**2 + then**2).sum()) / 2.0
    share = size / (size + PAIRS * 2.0 * noise_px**2)
    rho = float((now * then).sum()) / max(size, 1e-300)
    return float(np.clip(share * rho + (1.0 - share) * USUAL, 0.0, MOST_CORRELATED))
