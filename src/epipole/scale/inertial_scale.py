"""The scale of a path from an inertial measurement unit, stretch by stretch."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from epipole._declared import checked
from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3
from epipole.inertial import ImuLog, ImuNoise, InertialAlignment, align_path_to_imu
from epipole.scale.scale_agreement import ScaleEstimate

APART_S = 0.25
"""Between poses that are used: nearer ones tell the same."""
LONGEST_S = 1.0
"""Between poses: over a longer gap the biases carry the unit too far."""
POSES, LEAST = 60, 12
"""In a stretch, at most and at least; the path's own scale may drift from one to the next."""


@checked
def fit_scale_to_imu(
    timestamp_s: Float64[np.ndarray, " n"],
    world_from_camera: Rigid3,
    log: ImuLog,
    camera_from_imu: Rigid3,
    noise: ImuNoise | None = None,
) -> ScaleEstimate:
    """The mean of the scales of stretches of some 15 s (`align_path_to_imu`), weighted by what each tells.

    Its deviation is the formal one, or that of the stretches' scatter where this is larger.

    Args:
        timestamp_s: of the path, rising, by the unit's clock.
        world_from_camera: the path, up to scale.
        log: measurements.
        camera_from_imu: how the unit is mounted, in metres.
        noise: densities; None: the defaults.

    Raises:
        DegenerateGeometryError: no stretch tells a scale; the message says why.
        ShapeError: the arrays do not fit, or times do not rise.
    """
    if world_from_camera.batch_shape() != timestamp_s.shape:
        raise ShapeError(f"{len(timestamp_s)} times are given for {world_from_camera.batch_shape()} poses")
    if (np.diff(timestamp_s) <= 0).any():
        raise ShapeError("times of poses must rise")
    stretches = _stretches(timestamp_s, log)
    if not stretches:
        raise DegenerateGeometryError(
            f"IMU: no {LEAST} poses in a row, at most {LONGEST_S:g} s apart, fall within its log"
        )
    found: list[InertialAlignment] = []
    problem = ""
    for rows in stretches:
        try:
            found.append(
                align_path_to_imu(timestamp_s[rows], world_from_camera[rows], log, camera_from_imu, noise)
            )
        except DegenerateGeometryError as error:
            problem = str(error)
    if not found:
        raise DegenerateGeometryError(f"IMU: {problem}")
    return _mean(found, len(stretches), (ImuNoise() if noise is None else noise).accel_gain_sigma)


def _stretches(times: np.ndarray, log: ImuLog) -> list[np.ndarray]:
    """Rows of poses, some tenths of a second apart, within the log; none across a gap."""
    if not len(log):
        return []
    kept: list[int] = []
    out = [kept]
    for row in np.flatnonzero((times >= log.timestamp_s[0]) & (times <= log.timestamp_s[-1])):
        since = times[row] - times[kept[-1]] if kept else np.inf
        if kept and since < APART_S * 0.999:
            continue
        if kept and (since > LONGEST_S or len(kept) == POSES):
            # Stretches share a pose where nothing parts them.
            kept = [kept[-1]] if since <= LONGEST_S else []
            out.append(kept)
        kept.append(int(row))
    return [np.array(rows) for rows in out if len(rows) >= LEAST]


def _mean(found: list[InertialAlignment], count: int, shared: float) -> ScaleEstimate:
    logs = np.log([one.scale for one in found])
    weight = np.array([1.0 / ((one.sigma / one.scale) ** 2 - shared**2) for one in found])
    mean = float((weight * logs).sum() / weight.sum())
    scatter = float((weight * (logs - mean) ** 2).sum()) / max(len(found) - 1, 1)
    sigma = float(np.sqrt(max(scatter, 1.0) / weight.sum()))
    scale = float(np.exp(mean))
    words = "the IMU" + (f" ({len(found)} of {count} stretches)" if count > 1 else "")
    return ScaleEstimate("imu", "the IMU", scale, scale * sigma, shared, words)
