"""The scale of a trajectory from distances measured along it, by wheels or by another odometry."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from epipole._checks import checked
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.scale.scale_agreement import ScaleEstimate

MOST_STRETCHES, LEAST_STRETCHES = 40, 6
STEPS_IN_STRETCH = 8
"""Steps per segment in which the model's trajectory is measured: frame by frame, noise would make it longer."""
OUTLIER, LEAST_SPREAD = 3.0, 1e-3
MOST_ROUNDS, MOST_STEPS, CONVERGED = 10, 100, 1e-12
LEAST_FRACTION = 0.1
"""Minimum fraction of the length that grows with the scale: below it, the lever alone explains the motion."""
TWICE = 2.0
"""A second root counts as a valid fit if its ratios scatter by at most this factor times those of the best."""


@checked
def fit_scale_to_distances(
    timestamp_s: Float64[np.ndarray, " n"],
    positions_in_model: Float64[np.ndarray, "n 3"],
    log_s: Float64[np.ndarray, " m"],
    traveled_m: Float64[np.ndarray, " m"] | None,
    positions_by_odometry: Float64[np.ndarray, "m 3"] | None,
    sigma: float,
    levers_m: Float64[np.ndarray, "n 3"] | None = None,
) -> ScaleEstimate:
    """The scale at which a trajectory has the measured length; its deviation comes from the scatter over segments.

    The trajectory is cut into segments of equal measured length. Each gives a ratio; ratios more than 3 robust deviations
    from their median are slip and are ignored. var(s) / s^2 = var(ratios) / n + sigma^2. Odometry positions are compared
    by the distance between the ends of a segment, which noise and curves do not change; traveled distances by the length
    of the model's trajectory in short steps.

    If the odometry measures another point than the camera, its positions in meters are s t + l, with the camera position
    t and the lever l. The scale s is the one at which the sum of |s dt + dl| over the used segments is the measured one.
    The sum is convex in s, so Newton's method converges from above; segments are then re-selected with that scale until
    the selection is stable. Only the part of the length that grows with s determines it, so the standard deviation is
    divided by that fraction. The sum may have a second root, at which the camera moves against the body; the root with
    the smaller scatter wins. The lever is assumed to be exact.

    Args:
        timestamp_s: times of the model's poses, increasing.
        positions_in_model: camera positions, in the model's unit.
        log_s: the odometry's times, increasing.
        traveled_m: distance since an arbitrary start; None if positions are given.
        positions_by_odometry: positions of the same body by odometry; None if distances are given.
        sigma: relative standard deviation of the odometry's unit of length.
        levers_m: from the camera to the point that the odometry measures, at each of the model's poses, in the model's axes
            and in meters; None: it measures the camera itself.

    Raises:
        DegenerateGeometryError: times do not overlap, no motion, the segments disagree, or two scales fit.
        ShapeError: array sizes do not match.
        ConfigError: sigma is outside [0, 1).
    """
    if not 0 <= sigma < 1:
        raise ConfigError(f"sigma must be a fraction in [0, 1), got {sigma}")
    if len(timestamp_s) != len(positions_in_model) or (traveled_m is None) == (positions_by_odometry is None):
        raise ShapeError(
            "timestamp_s must have a row per position, and exactly one of traveled_m and positions_by_odometry be given"
        )
    if len(log_s) > 1 and (np.diff(log_s) <= 0).any():
        raise ShapeError("log_s must increase")
    levers = np.zeros_like(positions_in_model) if levers_m is None else levers_m
    if levers.shape != positions_in_model.shape or not np.isfinite(levers).all():
        raise ShapeError(f"levers_m must have {len(positions_in_model)} finite rows, one per position")
    path = timestamp_s, positions_in_model, levers
    trajectory, total_m = _trajectory(path, (log_s, traveled_m, positions_by_odometry))
    return _estimate(trajectory, sigma, total_m)


def _trajectory(
    path: tuple[np.ndarray, np.ndarray, np.ndarray],
    odometry: tuple[np.ndarray, np.ndarray | None, np.ndarray | None],
) -> tuple[_Trajectory, float]:
    """The part of the trajectory that the odometry covers, and its length by odometry in meters."""
    timestamp_s, positions_in_model, levers = path
    log_s, traveled_m, positions_by_odometry = odometry
    within = (timestamp_s >= log_s[:1].min(initial=np.inf)) & (timestamp_s <= log_s[-1:].max(initial=-np.inf))
    inside = np.flatnonzero(within)
    if len(inside) < LEAST_STRETCHES + 1:
        raise DegenerateGeometryError(
            f"odometry: its times cover {len(inside)} posed images, {LEAST_STRETCHES + 1} are needed"
        )
    times, positions, levers = timestamp_s[inside], positions_in_model[inside], levers[inside]
    wheels = _along(log_s, traveled_m, positions_by_odometry, times)
    if not wheels[-1] > 0:
        raise DegenerateGeometryError("odometry: it did not move while the images were taken")
    cuts = _cuts(wheels, MOST_STRETCHES)
    if traveled_m is not None:
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
    """A trajectory in steps, and the measured lengths of its segments."""

    moved: np.ndarray  # (k, 3) steps of the camera, in the model's unit
    swung: np.ndarray  # (k, 3) changes of the lever, in meters
    stretch: np.ndarray  # (k,) segment of each step
    measured: np.ndarray  # (c,) meters along each segment

    def lengths(self, scale: float) -> tuple[np.ndarray, np.ndarray]:
        """(c,) meters along each segment at a scale, and their derivatives by its logarithm."""
        step = scale * self.moved + self.swung
        size = np.linalg.norm(step, axis=1)
        along = np.einsum("ki,ki->k", scale * self.moved, step) / np.where(size > 0, size, 1.0)
        count = len(self.measured)
        return np.bincount(self.stretch, size, count), np.bincount(self.stretch, along, count)


def _along(
    log_s: np.ndarray, traveled_m: np.ndarray | None, positions: np.ndarray | None, times: np.ndarray
) -> np.ndarray:
    """Measured distance from the first image to each image."""
    if traveled_m is None:
        assert positions is not None
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        traveled_m = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.interp(times, log_s, traveled_m)
    return at - at[0]


def _cuts(wheels: np.ndarray, count: int) -> np.ndarray:
    """Rows at which segments end: the first, the last, and up to count - 1 between them."""
    wanted = np.linspace(0.0, wheels[-1], min(count, len(wheels) - 1) + 1)
    return np.unique([0, *np.searchsorted(wheels, wanted[1:-1]), len(wheels) - 1])


class _Fit(NamedTuple):
    """A scale, and how well the segments agree on it."""

    scale: float
    logs: np.ndarray  # (c,) logarithms of measured over modeled lengths; NaN for segments that are too short
    kept: np.ndarray  # (c,) segments that agree
    fraction: float  # part of the modeled length that grows with the scale

    @property
    def scatter(self) -> float:
        """Standard deviation of one ratio."""
        return float(self.logs[self.kept].std(ddof=1))


def _estimate(trajectory: _Trajectory, sigma: float, total_m: float) -> ScaleEstimate:
    swung = float(np.linalg.norm(trajectory.swung, axis=1).sum())
    moved = float(np.linalg.norm(trajectory.moved, axis=1).sum())
    if not moved > 0:
        raise DegenerateGeometryError("odometry: the camera did not move while the odometry did")
    # At the first start the modeled length is at least the measured one; at the second it is mostly the lever's.
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
                f"odometry: two scales fit with this mounting, {fit.scale:.4g} and {other.scale:.4g}"
            )
    if abs(fit.fraction) < LEAST_FRACTION:
        raise DegenerateGeometryError(
            "odometry: rotation about the mounting alone explains the camera's motion, so the scale is undetermined"
        )
    count = int(fit.kept.sum())
    deviation = max(fit.scatter / np.sqrt(count), 1e-6) / abs(fit.fraction)
    words = f"{total_m:.3g} m of odometry ({count} of {len(trajectory.measured)} segments agree)"
    return ScaleEstimate(
        "odometry", "odometry", fit.scale, fit.scale * deviation, sigma / abs(fit.fraction), words
    )


def _fit(trajectory: _Trajectory, start: float) -> _Fit:
    """The scale at which the modeled segments that agree have the measured length."""
    kept, count = np.ones(len(trajectory.measured), bool), len(trajectory.measured)
    for _ in range(MOST_ROUNDS):
        scale = _solved(trajectory, kept, start)
        length, grown = trajectory.lengths(scale)
        usable = (length > 0.05 * np.median(length)) & (
            trajectory.measured > 0.05 * np.median(trajectory.measured)
        )
        if usable.sum() < LEAST_STRETCHES:
            raise DegenerateGeometryError(
                f"odometry: only {int(usable.sum())} segments are long enough, {LEAST_STRETCHES} are needed"
            )
        logs = np.full(count, np.nan)
        logs[usable] = np.log(trajectory.measured[usable] / length[usable])
        off = np.abs(logs - np.nanmedian(logs))
        before, kept = kept, off <= OUTLIER * max(1.4826 * float(np.nanmedian(off)), LEAST_SPREAD)
        if 2 * kept.sum() <= count or kept.sum() < LEAST_STRETCHES:
            raise DegenerateGeometryError(
                f"odometry: of {count} segments only {int(kept.sum())} agree on a scale"
            )
        if np.array_equal(kept, before):
            break
    scale = _solved(trajectory, kept, start)
    length, grown = trajectory.lengths(scale)
    return _Fit(scale, logs, kept, float(grown[kept].sum() / length[kept].sum()))


def _solved(trajectory: _Trajectory, kept: np.ndarray, start: float) -> float:
    """By Newton's method: the modeled length is convex in the scale, so steps from the steeper side do not overshoot."""
    wanted, scale = float(trajectory.measured[kept].sum()), start
    for _ in range(MOST_STEPS):
        length, grown = trajectory.lengths(scale)
        slope = float(grown[kept].sum())
        step = (wanted - float(length[kept].sum())) / slope if slope else np.nan
        # If the length is already too short at the start, there is no root on its side.
        if not np.isfinite(step) or not 1.0 + step > 0:
            raise DegenerateGeometryError("odometry: no scale makes the trajectory match the measured length")
        scale *= 1.0 + step
        if abs(step) < CONVERGED:
            return scale
    raise DegenerateGeometryError("odometry: no scale makes the trajectory match the measured length")
