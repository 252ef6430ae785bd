"""Errors of the scale that an IMU determines, against its standard deviation. `python -m benchmarks.inertial`.

The data are synthetic hand-held motions, the same at constant velocity (no scale is observable), sections of EuRoC's real IMU log
with the drone's true trajectory, and SLAM of a rendered room with one camera and with a pair, with and without a synthetic IMU.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from epipole.errors import DegenerateGeometryError
from epipole.geometry import Rigid3, Rotation3
from epipole.inertial import MountedImu, align_path_to_imu
from epipole.io.sequences.imu_logs import read_imu
from epipole.metrics import absolute_error
from epipole.pipelines.slam.frames import Frame, SlamCamera
from epipole.pipelines.slam.map.imu import MOST_ALIGNED
from epipole.pipelines.slam.output.scale import scale_by_imu
from epipole.pipelines.slam.slam import Slam
from epipole.scale import fit_scale_to_imu
from epipole.synthetic.inertial import imu_and_biases_along, inertial_path
from epipole.synthetic.rides import loop_room

RESULTS = REPOSITORY / "benchmarks" / "results" / "inertial.json"
SECTION_S = 15.0
"""Length of a section of EuRoC."""
UNIT = 2.5
"""Meters per unit of the scaled EuRoC trajectory: the scale to estimate."""
MOUNTING_SIGMA = np.array([0.05, 0.05, 0.05, 1.0, 1.0, 1.0])
"""Standard deviations of the IMU's pose on the camera, in meters and radians."""
RIDES = 8
"""Number of SLAM runs with an IMU."""

Trial = tuple[float, float, float] | None
"""True scale, estimated scale and its standard deviation; None if there is no estimate."""


def synthetic(count: int, *, constant_velocity: bool) -> Iterator[Trial]:
    """Synthetic motions with seeds 0 to count - 1."""
    for seed in range(count):
        motion = inertial_path(seed, constant_velocity=constant_velocity)
        try:
            found = align_path_to_imu(motion.timestamp_s, motion.world_from_camera, motion.imu())
        except DegenerateGeometryError:
            yield None
        else:
            yield motion.scale, found.scale, found.sigma


def calibrated(count: int, *, is_metric: bool) -> dict[str, Any]:
    """Errors of gravity and biases on the synthetic motions, up to scale or, as with a stereo pair, in meters."""
    degrees, over_sigma = [], []
    for seed in range(count):
        motion = inertial_path(seed)
        path = motion.world_from_camera
        if is_metric:
            path = Rigid3(path.rotation, path.translation * motion.scale)
        found = align_path_to_imu(motion.timestamp_s, path, motion.imu(), is_metric=is_metric)
        degrees.append(_angle_deg(found.gravity_in_world, motion.gravity_in_world))
        off = np.concatenate([found.gyro_bias - motion.gyro_bias, found.accel_bias - motion.accel_bias])
        over_sigma.append(np.abs(off) / np.sqrt(np.diag(found.calibration.covariance)[:6]))
    within = np.array(over_sigma) <= 2.0
    return {
        "name": "synthetic motion in meters" if is_metric else "synthetic motion up to scale",
        "seeds": count,
        "gravity_deg_median": float(np.median(degrees)),
        "gravity_deg_largest": float(np.max(degrees)),
        "gravity_within_0.3_deg": float((np.array(degrees) <= 0.3).mean()),
        "gyro_bias_within_2_sigma": float(within[:, :3].mean()),
        "accel_bias_within_2_sigma": float(within[:, 3:].mean()),
    }


def _calibration_table(rows: list[dict[str, Any]]) -> Table:
    table = Table(
        *("data", "seeds", "gravity (median)", "largest", "within 0.3 deg"),
        *("gyroscope's bias within 2 sigma", "accelerometer's"),
    )
    for row in rows:
        degrees = [
            "-" if row[key] is None else f"{row[key]:.2f} deg"
            for key in ("gravity_deg_median", "gravity_deg_largest")
        ]
        keys = "gravity_within_0.3_deg", "gyro_bias_within_2_sigma", "accel_bias_within_2_sigma"
        fractions = ("-" if row[key] is None else f"{100 * row[key]:.0f} %" for key in keys)
        table.add_row(row["name"], str(row["seeds"]), *degrees, *fractions)
    return table


def _angle_deg(one: np.ndarray, other: np.ndarray) -> float:
    across = float(np.linalg.norm(np.cross(one, other)))
    return float(np.degrees(np.arctan2(across, one @ other)))


def euroc(folder: Path, *, whole: bool) -> Iterator[Trial]:
    """Sections of the flight, starting every 5 s; or the whole flight."""
    log, noise = read_imu(folder / "mav0" / "imu0")
    imu = MountedImu(log, Rigid3.identity(), noise)
    rows = np.loadtxt(folder / "V1_01_easy.csv", delimiter=",")[::5]
    times = rows[:, 0] * 1e-9
    inside = (times > log.timestamp_s[0]) & (times < log.timestamp_s[-1])
    rows, times = rows[inside], times[inside]
    poses = Rigid3(Rotation3.from_quat_wxyz(rows[:, 4:8]).matrix, rows[:, 1:4] / UNIT)
    if whole:
        fitted = fit_scale_to_imu(times, poses, imu)
        yield UNIT, fitted.scale, fitted.scale * fitted.fraction
        return
    for start in np.arange(times[0], times[-1] - SECTION_S, 5.0):
        section = np.flatnonzero((times >= start) & (times < start + SECTION_S))
        try:
            found = align_path_to_imu(times[section], poses[section], imu)
        except DegenerateGeometryError:
            yield None
        else:
            yield UNIT, found.scale, found.sigma


def tracked(count: int, sensor: str) -> tuple[list[Trial], dict[str, Any]]:
    """SLAM of the room without an IMU, then with IMUs of seeds 0 to count - 1: scales, and errors of positions, gravity and biases.

    Biases are those of the last keyframes, aligned once more.
    """
    ride = loop_room(200, (320, 240))
    numbers, has_pair = range(0, 200, 2), sensor == "pair"
    frames = [
        Frame(n / 10.0, ride.left(number).gray, ride.right(number).gray if has_pair else None)
        for n, number in enumerate(numbers)
    ]
    truth = ride.world_from_camera[np.array(numbers)]
    truth = truth[0].inverse() @ truth
    times = np.array([frame.timestamp_s for frame in frames])
    trials: list[Trial] = []
    errors, gravity_deg, over_sigma = [], [], []
    for seed in range(-1, count):
        mounting = Rigid3.exp(np.random.default_rng([3, max(seed, 0)]).normal(size=6) * MOUNTING_SIGMA)
        log, *biases = imu_and_biases_along(times, truth, mounting, max(seed, 0))
        imu = MountedImu(log, mounting)
        system = Slam(
            SlamCamera(ride.camera, ride.baseline if has_pair else None), imu=imu if seed >= 0 else None
        )
        for frame in frames:
            system.track(frame)
        system.finish()
        trajectory = system.trajectory()
        rows = np.rint(10 * trajectory.timestamp_s).astype(int)
        error = absolute_error(trajectory.world_from_body, truth[rows], "rigid" if has_pair else "similarity")
        errors.append(1e3 * error.position.rmse)
        if seed < 0:
            continue
        down = system.gravity_in_world
        if down is not None:
            axes = _mean_rotation(truth[rows].rotation, trajectory.world_from_body.rotation)
            gravity_deg.append(_angle_deg(axes @ down, np.array([0.0, 0.0, -1.0])))
        over_sigma += _bias_errors(system, imu, biases, is_metric=has_pair)
        found = None if has_pair else scale_by_imu(system)
        trials.append(
            found and (float(error.truth_from_estimate.scale), found.scale, found.fraction * found.scale)
        )
    within = np.array(over_sigma).reshape(-1, 6) <= 2.0
    return trials, {
        "name": f"SLAM of the room, {sensor}",
        "seeds": count,
        "error_mm_alone": errors[0],
        "error_mm_median": float(np.median(errors[1:])),
        "gravity_found": len(gravity_deg),
        "gravity_deg_median": float(np.median(gravity_deg)) if gravity_deg else None,
        "gravity_deg_largest": float(np.max(gravity_deg)) if gravity_deg else None,
        "gravity_within_0.3_deg": float((np.array(gravity_deg) <= 0.3).mean()) if gravity_deg else None,
        "biases_determined": len(within),
        "gyro_bias_within_2_sigma": float(within[:, :3].mean()) if len(within) else None,
        "accel_bias_within_2_sigma": float(within[:, 3:].mean()) if len(within) else None,
    }


def _mean_rotation(truth: np.ndarray, estimate: np.ndarray) -> np.ndarray:
    """(3, 3) truth_from_estimate of the worlds of n rotations: positions of a few meters would determine it to 0.2 degrees only."""
    left, _, right = np.linalg.svd((truth @ np.swapaxes(estimate, 1, 2)).mean(axis=0))
    return left @ right


def _bias_errors(
    system: Slam, imu: MountedImu, biases: list[np.ndarray], *, is_metric: bool
) -> list[np.ndarray]:
    """(6,) errors of the mean biases over the last keyframes, in standard deviations; none if they do not determine them."""
    covered = [k for k in system.maps[0].keyframes if k.timestamp_s <= imu.log.timestamp_s[-1]]
    keyframes = covered[-MOST_ALIGNED:]
    times = np.array([keyframe.timestamp_s for keyframe in keyframes])
    poses = Rigid3.stack([keyframe.cam_from_world.inverse() for keyframe in keyframes])
    try:
        found = align_path_to_imu(times, poses, imu, is_metric=is_metric)
    except DegenerateGeometryError:
        return []
    during = (imu.log.timestamp_s >= times[0]) & (imu.log.timestamp_s <= times[-1])
    gyro, accel = (bias[during].mean(axis=0) for bias in biases)
    off = np.concatenate([found.gyro_bias - gyro, found.accel_bias - accel])
    return [np.abs(off) / np.sqrt(np.diag(found.calibration.covariance)[:6])]


def summary_of(name: str, trials: Iterable[Trial]) -> dict[str, Any]:
    """Numbers of trials, and relative errors of the scales."""
    start, all_trials = time.perf_counter(), list(trials)
    found = np.array([trial for trial in all_trials if trial is not None]).reshape(-1, 3)
    error, sigma = found[:, 1] / found[:, 0] - 1.0, found[:, 2] / found[:, 1]
    return {
        "name": name,
        "tried": len(all_trials),
        "refused": len(all_trials) - len(found),
        "within_2_sigma": float((np.abs(error) <= 2 * sigma).mean()) if len(found) else None,
        "within_2_percent": float((np.abs(error) <= 0.02).mean()) if len(found) else None,
        "largest_error": float(np.abs(error).max()) if len(found) else None,
        "median_sigma": float(np.median(sigma)) if len(found) else None,
        "seconds_each": (time.perf_counter() - start) / max(len(all_trials), 1),
    }


def main() -> None:
    """Run all trials, print the table and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--rides", type=int, default=RIDES, help="SLAM runs with an IMU")
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    arguments = parser.parse_args()
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    folder = data / "slam" / "euroc_static"
    rows = [
        summary_of("synthetic motion", synthetic(arguments.seeds, constant_velocity=False)),
        summary_of("constant velocity", synthetic(arguments.seeds, constant_velocity=True)),
    ]
    if folder.is_dir():
        rows.append(summary_of("EuRoC V1_01, sections of 15 s", euroc(folder, whole=False)))
        rows.append(summary_of("EuRoC V1_01, the whole flight", euroc(folder, whole=True)))
    rides = []
    for sensor in ("one camera", "pair"):
        trials, ride = tracked(arguments.rides, sensor)
        rides.append(ride)
        if sensor == "one camera":
            rows.append(summary_of("SLAM of the room with an IMU", trials))
    table = Table(
        *("data", "trials", "refused", "within 2 sigma", "within 2 %"),
        *("largest error", "median sigma", "s per trial"),
    )
    for row in rows:
        fractions = [
            row[key] for key in ("within_2_sigma", "within_2_percent", "largest_error", "median_sigma")
        ]
        words = ["-" if fraction is None else f"{100 * fraction:.3g} %" for fraction in fractions]
        table.add_row(
            row["name"], str(row["tried"]), str(row["refused"]), *words, f"{row['seconds_each']:.2f}"
        )
    Console().print(table)
    calibration = [calibrated(arguments.seeds, is_metric=is_metric) for is_metric in (False, True)]
    Console().print(_calibration_table([*calibration, *rides]))
    for ride in rides:
        Console().print(
            f"{ride['name']}: positions {ride['error_mm_alone']:.2f} mm off without an IMU, "
            f"{ride['error_mm_median']:.2f} mm with one (median)"
        )
    found = {"machine": describe_machine(1), "rows": rows, "calibration": calibration, "slam": rides}
    RESULTS.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
