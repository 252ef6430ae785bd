"""The scale of a path from distances that were measured along it: by wheels, or by another odometry."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from epipole._declared import checked
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.scale.scale_agreement import ScaleEstimate

MOST_STRETCHES, LEAST_STRETCHES = 40, 6
STEPS_IN_STRETCH = 8
"""The path is measured in so many steps, not from frame to frame: its noise would make it longer."""
OUTLIER, LEAST_SPREAD = 3.0, 1e-3
MOST_ROUNDS, MOST_STEPS, CONVERGED = 10, 100, 1e-12
LEAST_FRACTION = 0.1
"""Of the way of the body, that which grows with the scale: below it the mounting tells the way, and not the scale."""
TWICE = 2.0
"""A second scale counts as fitting, too, whose ratios scatter by no more than so many times those of the best."""


@checked
def fit_scale_to_distances(
    timestamp_s: Float64[np.ndarray, " n"],
    positions_in_model: Float64[np.ndarray, "n 3"],
    log_s: Float64[np.ndarray, " m"],
    travelled_m: Float64[np.ndarray, " m"] | None,
    positions_by_odometry: Float64[np.ndarray, "m 3"] | None,
    sigma: float,
    levers_m: Float64[np.ndarray, "n 3"] | None = None,
) -> ScaleEstimate:
    """The scale by which a path is as long as was measured, and its deviation by the scatter over stretches of the way.

    The way is cut into stretches of equal measured length, and each tells a ratio; those far from their median are slip (3
    robust deviations) and do not count. var(s) / s^2 = var(ratios) / n + sigma^2. Of places by odometry the distance from
    the begin to the end of a stretch is compared, which noise and bends do not change; of distances along the way the
    model's path in short steps.

    Where odometry tells of another point than the camera, its places in metres are s t + l, with the camera's place t and
    the lever l. The scale s is that at which the sum of |s dt + dl| over the stretches that count is the measured one. The
    sum is convex in s, so that Newton's method from beyond it converges; stretches are judged by that scale again, until
    the same ones count. Only the part of the way that grows with s tells it, and the deviation is larger by that share.
    The sum may have a second root, at which the camera goes against the body; the root with the smaller scatter is taken.
    The lever itself is taken to be exact.

    Args:
        timestamp_s: of the model's places, rising.
        positions_in_model: places of the camera, in the model's unit.
        log_s: the odometry's times, rising.
        travelled_m: distance since any begin; None where places are given.
        positions_by_odometry: places by odometry, of the same body; None where distances are given.
        sigma: standard deviation of the wheels' unit, as a share.
        levers_m: from the camera to the point that odometry tells of, at each of the model's places, in the model's axes and
            in metres; None: it tells of the camera.

    Raises:
        DegenerateGeometryError: the times do not meet, it stood still, the stretches do not agree, or two scales fit.
        ShapeError: the arrays do not fit.
        ConfigError: sigma is negative.
    """
    if not 0 <= sigma < 1:
        raise ConfigError(f"sigma is a share, from 0 to below 1, got {sigma}")
    if len(timestamp_s) != len(positions_in_model) or (travelled_m is None) == (
        positions_by_odometry is None
    ):
        raise ShapeError("a time for every place, and either distances or places by odometry are needed")
    if len(log_s) > 1 and (np.diff(log_s) <= 0).any():
        raise ShapeError("times of odometry must rise")
    levers = np.zeros_like(positions_in_model) if levers_m is None else levers_m
    if levers.shape != positions_in_model.shape or not np.isfinite(levers).all():
        raise ShapeError(f"{len(positions_in_model)} places need as many levers, of finite numbers")
    path = timestamp_s, positions_in_model, levers
    trajectory, total_m = _trajectory(path, (log_s, travelled_m, positions_by_odometry))
    return _estimate(trajectory, sigma, total_m)


def _trajectory(
    path: tuple[np.ndarray, np.ndarray, np.ndarray],
    odometry: tuple[np.ndarray, np.ndarray | None, np.ndarray | None],
) -> tuple[_Trajectory, float]:
    """The way that both tell of, and how long it is by odometry."""
    timestamp_s, positions_in_model, levers = path
    log_s, travelled_m, positions_by_odometry = odometry
    within = (timestamp_s >= log_s[:1].min(initial=np.inf)) & (timestamp_s <= log_s[-1:].max(initial=-np.inf))
    inside = np.flatnonzero(within)
    if len(inside) < LEAST_STRETCHES + 1:
        raise DegenerateGeometryError(
            f"odometry: {len(inside)} images with a place fall within its times, {LEAST_STRETCHES + 1} are needed"
        )
    times, positions, levers = timestamp_s[inside], positions_in_model[inside], levers[inside]
    wheels = _along(log_s, travelled_m, positions_by_odometry, times)
    if not wheels[-1] > 0:
        raise DegenerateGeometryError("odometry: it stood still while the images were taken")
    cuts = _cuts(wheels, MOST_STRETCHES)
    if travelled_m is not None:
        rows = np.unique([*_cuts(wheels, MOST_STRETCHES * STEPS_IN_STRETCH), *cuts])
        measured = np.diff(wheels[cuts])
    else:
        assert positions_by_odometry is not None
        rows = cuts
        there = np.stack(
            [np.interp(times[cuts], log_s, positions_by_odometry[:, k]) for k in range(3)], axis=1
        )
        measured = np.linalg.norm(np.diff(there, axis=0), axis=1)
    stretch = np.searchsorted(cuts, rows[:-1], side="right") - 1
    moved, swung = np.diff(positions[rows], axis=0), np.diff(levers[rows], axis=0)
    return _Trajectory(moved, swung, stretch, measured), float(wheels[-1])


class _Trajectory(NamedTuple):
    """A path in steps, and what was measured along its stretches."""

    moved: np.ndarray  # (k, 3) of the camera, in the model's unit
    swung: np.ndarray  # (k, 3) of the lever, in metres
    stretch: np.ndarray  # (k,) of each step
    measured: np.ndarray  # (c,) metres along each stretch

    def lengths(self, scale: float) -> tuple[np.ndarray, np.ndarray]:
        """(c,) metres along each stretch at a scale, and their derivatives by its logarithm."""
        step = scale * self.moved + self.swung
        size = np.linalg.norm(step, axis=1)
        along = np.einsum("ki,ki->k", scale * self.moved, step) / np.where(size > 0, size, 1.0)
        count = len(self.measured)
        return np.bincount(self.stretch, size, count), np.bincount(self.stretch, along, count)


def _along(
    log_s: np.ndarray, travelled_m: np.ndarray | None, positions: np.ndarray | None, times: np.ndarray
) -> np.ndarray:
    """Measured distance from the first image to each."""
    if travelled_m is None:
        assert positions is not None
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        travelled_m = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.interp(times, log_s, travelled_m)
    return at - at[0]


def _cuts(wheels: np.ndarray, count: int) -> np.ndarray:
    """Rows at which a stretch ends: the first and the last, and so many between them as the rows allow."""
    wanted = np.linspace(0.0, wheels[-1], min(count, len(wheels) - 1) + 1)
    return np.unique([0, *np.searchsorted(wheels, wanted[1:-1]), len(wheels) - 1])


class _Fit(NamedTuple):
    """A scale, and how well the stretches agree on it."""

    scale: float
    logs: np.ndarray  # (c,) logarithms of measured over modelled lengths; NaN for those too short to tell one
    kept: np.ndarray  # (c,) which agree
    fraction: float  # of the modelled way, that which grows with the scale

    @property
    def scatter(self) -> float:
        """Deviation of one ratio."""
        return float(self.logs[self.kept].std(ddof=1))


def _estimate(trajectory: _Trajectory, sigma: float, total_m: float) -> ScaleEstimate:
    swung = float(np.linalg.norm(trajectory.swung, axis=1).sum())
    moved = float(np.linalg.norm(trajectory.moved, axis=1).sum())
    if not moved > 0:
        raise DegenerateGeometryError("odometry: the camera stood still while the wheels turned")
    # At the first of these the modelled way is at least as long as the measured one, at the second it is the lever's.
    largest = (float(trajectory.measured.sum()) + swung) / moved
    starts = [largest, 1e-3 * largest] if swung > 0 else [largest]
    fits, problem = [], ""
    for start in starts:
        try:
            fits.append(_fit(trajectory, start))
        except DegenerateGeometryError as error:
            problem = problem or str(error)
    if not fits:
        raise DegenerateGeometryError(problem)
    fit = min(fits, key=lambda one: one.scatter)
    for other in fits:
        is_other = abs(np.log(other.scale / fit.scale)) > LEAST_SPREAD
        if is_other and other.scatter <= TWICE * max(fit.scatter, LEAST_SPREAD):
            raise DegenerateGeometryError(
                f"odometry: with its mounting two scales fit, {fit.scale:.4g} and {other.scale:.4g}"
            )
    if abs(fit.fraction) < LEAST_FRACTION:
        raise DegenerateGeometryError(
            "odometry: the camera went where the turns of its mounting took it, that tells no scale"
        )
    count = int(fit.kept.sum())
    deviation = max(fit.scatter / np.sqrt(count), 1e-6) / abs(fit.fraction)
    words = f"{total_m:.3g} m of odometry ({count} of {len(trajectory.measured)} stretches agree)"
    return ScaleEstimate(
        "odometry", "odometry", fit.scale, fit.scale * deviation, sigma / abs(fit.fraction), words
    )


def _fit(trajectory: _Trajectory, start: float) -> _Fit:
    """The scale at which the modelled stretches that count are as long as the measured ones."""
    kept, count = np.ones(len(trajectory.measured), bool), len(trajectory.measured)
    for _ in range(MOST_ROUNDS):
        scale = _solved(trajectory, kept, start)
        length, grown = trajectory.lengths(scale)
        usable = (length > 0.05 * np.median(length)) & (
            trajectory.measured > 0.05 * np.median(trajectory.measured)
        )
        if usable.sum() < LEAST_STRETCHES:
            raise DegenerateGeometryError(
                f"odometry: only {int(usable.sum())} stretches of the way tell a ratio, {LEAST_STRETCHES} are needed"
            )
        logs = np.full(count, np.nan)
        logs[usable] = np.log(trajectory.measured[usable] / length[usable])
        off = np.abs(logs - np.nanmedian(logs))
        before, kept = kept, off <= OUTLIER * max(1.4826 * float(np.nanmedian(off)), LEAST_SPREAD)
        if 2 * kept.sum() <= count or kept.sum() < LEAST_STRETCHES:
            raise DegenerateGeometryError(
                f"odometry: of {count} stretches of the way only {int(kept.sum())} agree on a scale"
            )
        if np.array_equal(kept, before):
            break
    scale = _solved(trajectory, kept, start)
    length, grown = trajectory.lengths(scale)
    return _Fit(scale, logs, kept, float(grown[kept].sum() / length[kept].sum()))


def _solved(trajectory: _Trajectory, kept: np.ndarray, start: float) -> float:
    """By Newton's method. The modelled way is convex in the scale: steps from its steeper side go to the root and not past it."""
    wanted, scale = float(trajectory.measured[kept].sum()), start
    for _ in range(MOST_STEPS):
        length, grown = trajectory.lengths(scale)
        slope = float(grown[kept].sum())
        step = (wanted - float(length[kept].sum())) / slope if slope else np.nan
        # A start at which the way is too short already has no root on its side.
        if not np.isfinite(step) or not 1.0 + step > 0:
            raise DegenerateGeometryError("odometry: at no scale is the way as long as was measured")
        scale *= 1.0 + step
        if abs(step) < CONVERGED:
            return scale
    raise DegenerateGeometryError("odometry: at no scale is the way as long as was measured")
