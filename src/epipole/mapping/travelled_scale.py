"""The scale of a path from distances that were measured along it: by wheels, or by another odometry."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from epipole._declared import checked
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.mapping.scale_agreement import ScaleEstimate

MOST_STRETCHES, LEAST_STRETCHES = 40, 6
STEPS_IN_STRETCH = 8
"""The path is measured in so many steps, not from frame to frame: its noise would make it longer."""
OUTLIER = 3.0


@checked
def fit_scale_to_distances(
    timestamp_s: Float64[np.ndarray, " n"],
    places_in_model: Float64[np.ndarray, "n 3"],
    log_s: Float64[np.ndarray, " m"],
    travelled_m: Float64[np.ndarray, " m"] | None,
    places_by_odometry: Float64[np.ndarray, "m 3"] | None,
    sigma: float,
) -> ScaleEstimate:
    """The scale by which a path is as long as was measured, and its deviation by the scatter over stretches of the way.

    The way is cut into stretches of equal measured length, and each tells a ratio; those far from their median are slip (3
    robust deviations) and do not count. var(s) / s^2 = var(ratios) / n + sigma^2. Of places by odometry the distance from
    the begin to the end of a stretch is compared, which noise and bends do not change; of distances along the way the
    model's path in short steps.

    Args:
        timestamp_s: of the model's places, rising.
        places_in_model: places of the camera, in the model's unit.
        log_s: the odometry's times, rising.
        travelled_m: distance since any begin; None where places are given.
        places_by_odometry: places by odometry, of the same body; None where distances are given.
        sigma: standard deviation of the wheels' unit, as a share.

    Raises:
        DegenerateGeometryError: the times do not meet, it stood still, or the stretches do not agree.
        ShapeError: the arrays do not fit.
        ConfigError: sigma is negative.
    """
    if not 0 <= sigma < 1:
        raise ConfigError(f"sigma is a share, from 0 to below 1, got {sigma}")
    if len(timestamp_s) != len(places_in_model) or (travelled_m is None) == (places_by_odometry is None):
        raise ShapeError("a time for every place, and either distances or places by odometry are needed")
    if len(log_s) > 1 and (np.diff(log_s) <= 0).any():
        raise ShapeError("times of odometry must rise")
    within = (timestamp_s >= log_s[:1].min(initial=np.inf)) & (timestamp_s <= log_s[-1:].max(initial=-np.inf))
    inside = np.flatnonzero(within)
    if len(inside) < LEAST_STRETCHES + 1:
        raise DegenerateGeometryError(
            f"odometry: {len(inside)} pictures with a place fall within its times, {LEAST_STRETCHES + 1} are needed"
        )
    times, places = timestamp_s[inside], places_in_model[inside]
    wheels = _along(log_s, travelled_m, places_by_odometry, times)
    if not wheels[-1] > 0:
        raise DegenerateGeometryError("odometry: it stood still while the pictures were taken")
    cuts = _cuts(wheels, MOST_STRETCHES)
    if travelled_m is not None:
        fine = _cuts(wheels, MOST_STRETCHES * STEPS_IN_STRETCH)
        steps = np.linalg.norm(np.diff(places[fine], axis=0), axis=1)
        length = np.concatenate([[0.0], np.cumsum(steps)])
        model = np.diff(np.interp(cuts, fine, length))
        measured = np.diff(wheels[cuts])
    else:
        assert places_by_odometry is not None
        there = np.stack([np.interp(times[cuts], log_s, places_by_odometry[:, k]) for k in range(3)], axis=1)
        measured = np.linalg.norm(np.diff(there, axis=0), axis=1)
        model = np.linalg.norm(np.diff(places[cuts], axis=0), axis=1)
    return _estimate(model, measured, sigma, float(wheels[-1]))


def _along(
    log_s: np.ndarray, travelled_m: np.ndarray | None, places: np.ndarray | None, times: np.ndarray
) -> np.ndarray:
    """Measured distance from the first picture to each."""
    if travelled_m is None:
        assert places is not None
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        travelled_m = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.interp(times, log_s, travelled_m)
    return at - at[0]


def _cuts(wheels: np.ndarray, count: int) -> np.ndarray:
    """Rows at which a stretch ends: the first and the last, and so many between them as the rows allow."""
    wanted = np.linspace(0.0, wheels[-1], min(count, len(wheels) - 1) + 1)
    return np.unique([0, *np.searchsorted(wheels, wanted[1:-1]), len(wheels) - 1])


def _estimate(model: np.ndarray, measured: np.ndarray, sigma: float, total_m: float) -> ScaleEstimate:
    usable = (model > 0.05 * np.median(model)) & (measured > 0.05 * np.median(measured))
    if usable.sum() < LEAST_STRETCHES:
        raise DegenerateGeometryError(
            f"odometry: only {int(usable.sum())} stretches of the way tell a ratio, {LEAST_STRETCHES} are needed"
        )
    logs = np.log(measured[usable] / model[usable])
    middle = float(np.median(logs))
    spread = 1.4826 * float(np.median(np.abs(logs - middle)))
    kept = np.abs(logs - middle) <= OUTLIER * max(spread, 1e-3)
    if 2 * kept.sum() <= len(model) or kept.sum() < LEAST_STRETCHES:
        raise DegenerateGeometryError(
            f"odometry: of {len(model)} stretches of the way only {int(kept.sum())} agree on a scale"
        )
    scale = float(measured[usable][kept].sum() / model[usable][kept].sum())
    scatter = float(logs[kept].std(ddof=1)) / np.sqrt(kept.sum())
    words = f"{total_m:.3g} m of odometry ({int(kept.sum())} of {len(model)} stretches agree)"
    return ScaleEstimate("odometry", "odometry", scale, scale * max(scatter, 1e-6), sigma, words)
