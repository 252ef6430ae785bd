"""The scale of a trajectory from an IMU, segment by segment."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from epipole._checks import checked
from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3
from epipole.inertial import ImuLog, InertialAlignment, MountedImu, align_path_to_imu
from epipole.scale.scale_agreement import ScaleEstimate

APART_S = 0.25
"""Minimum time between poses: closer poses add no information."""
LONGEST_S = 1.0
"""Maximum time between poses: over longer gaps the IMU's biases integrate to too large an error."""
POSES = 60  # maximum per segment: the trajectory's own scale may drift between segments
LEAST = 12  # minimum per segment


@checked
def fit_scale_to_imu(
    timestamp_s: Float64[np.ndarray, " n"],
    world_from_camera: Rigid3,
    imu: MountedImu,
) -> ScaleEstimate:
    """Weighted mean of the scales of segments of about 15 s (`align_path_to_imu`).

    Its standard deviation is the formal one, or that of the segments' scatter if larger.

    Args:
        timestamp_s: times of the poses, increasing, by the IMU's clock.
        world_from_camera: the trajectory, up to scale.
        imu: measurements, mounting and noise.

    Raises:
        DegenerateGeometryError: no segment determines the scale.
        ShapeError: array sizes do not match, or times do not increase.
    """
    if world_from_camera.batch_shape() != timestamp_s.shape:
        raise ShapeError(
            f"timestamp_s has {len(timestamp_s)} rows for {world_from_camera.batch_shape()} poses"
        )
    if (np.diff(timestamp_s) <= 0).any():
        raise ShapeError("timestamp_s must increase")
    stretches = _stretches(timestamp_s, imu.log)
    if not stretches:
        raise DegenerateGeometryError(
            f"IMU: its log covers no {LEAST} consecutive poses at most {LONGEST_S:g} s apart"
        )
    found: list[InertialAlignment] = []
    problem = ""
    for rows in stretches:
        try:
            found.append(align_path_to_imu(timestamp_s[rows], world_from_camera[rows], imu))
        except DegenerateGeometryError as error:
            problem = str(error)
    if not found:
        raise DegenerateGeometryError(f"IMU: {problem}")
    return _mean(found, len(stretches), imu.noise.accel_gain_sigma)


def _stretches(times: np.ndarray, log: ImuLog) -> list[np.ndarray]:
    """Rows of poses per segment: within the log, spaced by APART_S, without long gaps."""
    if not len(log):
        return []
    kept: list[int] = []
    out = [kept]
    for row in np.flatnonzero((times >= log.timestamp_s[0]) & (times <= log.timestamp_s[-1])):
        since = times[row] - times[kept[-1]] if kept else np.inf
        if kept and since < APART_S * 0.999:
            continue
        if kept and (since > LONGEST_S or len(kept) == POSES):
            # Consecutive segments share a pose unless a gap separates them.
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
    words = "the IMU" + (f" ({len(found)} of {count} segments)" if count > 1 else "")
    return ScaleEstimate("imu", "the IMU", scale, scale * sigma, shared, words)
