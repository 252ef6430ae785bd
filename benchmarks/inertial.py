"""Whether an IMU's scale lies where it is said to lie. `python -m benchmarks.inertial`.

Drawn motions of a hand-held unit (50 seeds), the same at constant velocity, which must be refused, and stretches of EuRoC's real
unit with the true path of its drone; and SLAM of a rendered room, alone and with a drawn unit in its adjustments.
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
from epipole.pipelines.slam.output.scale import scale_by_imu
from epipole.pipelines.slam.slam import Slam
from epipole.scale import fit_scale_to_imu
from epipole.synthetic.inertial import imu_along, inertial_path
from epipole.synthetic.rides import loop_room

RESULTS = REPOSITORY / "benchmarks" / "results" / "inertial.json"
STRETCH_S, UNIT = 15.0, 2.5
"""Length of EuRoC's stretches, and the metres of a unit that nobody is told."""

MOUNTED = np.array([0.05, 0.05, 0.05, 1.0, 1.0, 1.0])
"""Deviations of how units are mounted, in metres and radians."""
RIDES = 8

Tried = tuple[float, float, float] | None
"""True scale, found, and its deviation; None for refused."""


def rendered(count: int, *, constant_velocity: bool) -> Iterator[Tried]:
    """Motions of seeds from 0 on."""
    for seed in range(count):
        path = inertial_path(seed, constant_velocity=constant_velocity)
        try:
            found = align_path_to_imu(
                path.timestamp_s, path.world_from_camera, path.log, path.camera_from_imu, path.noise
            )
        except DegenerateGeometryError:
            yield None
        else:
            yield path.scale, found.scale, found.sigma


def euroc(folder: Path, *, whole: bool) -> Iterator[Tried]:
    """Stretches that begin 5 s apart, or the whole flight."""
    log, noise = read_imu(folder / "mav0" / "imu0")
    rows = np.loadtxt(folder / "V1_01_easy.csv", delimiter=",")[::5]
    times = rows[:, 0] * 1e-9
    inside = (times > log.timestamp_s[0]) & (times < log.timestamp_s[-1])
    rows, times = rows[inside], times[inside]
    path = Rigid3(Rotation3.from_quat_wxyz(rows[:, 4:8]).matrix, rows[:, 1:4] / UNIT)
    if whole:
        one = fit_scale_to_imu(times, path, log, Rigid3.identity(), noise)
        yield UNIT, one.scale, one.scale * one.fraction
        return
    for start in np.arange(times[0], times[-1] - STRETCH_S, 5.0):
        own = np.flatnonzero((times >= start) & (times < start + STRETCH_S))
        try:
            found = align_path_to_imu(times[own], path[own], log, Rigid3.identity(), noise)
        except DegenerateGeometryError:
            yield None
        else:
            yield UNIT, found.scale, found.sigma


def tracked(count: int) -> tuple[list[Tried], list[float]]:
    """SLAM of the room with one camera, half size, with units of seeds from 0 on; and its errors, in mm, the first without."""
    ride = loop_room(200, (320, 240))
    numbers = range(0, 200, 2)
    frames = [Frame(n / 10.0, ride.left(number).grey) for n, number in enumerate(numbers)]
    truth = ride.world_from_camera[np.array(numbers)]
    truth = truth[0].inverse() @ truth
    times = np.array([frame.timestamp_s for frame in frames])
    tried: list[Tried] = []
    errors = []
    for seed in range(-1, count):
        mounting = Rigid3.exp(np.random.default_rng([3, max(seed, 0)]).normal(size=6) * MOUNTED)
        unit = MountedImu(imu_along(times, truth, mounting, seed), mounting) if seed >= 0 else None
        system = Slam(SlamCamera(ride.camera), imu=unit)
        for frame in frames:
            system.track(frame)
        system.finish()
        path = system.trajectory()
        rows = np.rint(10 * path.timestamp_s).astype(int)
        error = absolute_error(path.world_from_body, truth[rows], "similarity")
        errors.append(1e3 * error.position.rmse)
        if unit is not None:
            given = scale_by_imu(system)
            tried.append(
                given and (float(error.truth_from_estimate.scale), given.scale, given.fraction * given.scale)
            )
    return tried, errors


def summary_of(name: str, tried: Iterable[Tried]) -> dict[str, Any]:
    """Counts and shares."""
    start, all_tried = time.perf_counter(), list(tried)
    given = np.array([one for one in all_tried if one is not None]).reshape(-1, 3)
    off, fraction = given[:, 1] / given[:, 0] - 1.0, given[:, 2] / given[:, 1]
    return {
        "name": name,
        "tried": len(all_tried),
        "refused": len(all_tried) - len(given),
        "within_2_sigma": float((np.abs(off) <= 2 * fraction).mean()) if len(given) else None,
        "within_2_percent": float((np.abs(off) <= 0.02).mean()) if len(given) else None,
        "largest_error": float(np.abs(off).max()) if len(given) else None,
        "median_sigma": float(np.median(fraction)) if len(given) else None,
        "seconds_each": (time.perf_counter() - start) / max(len(all_tried), 1),
    }


def main() -> None:
    """Run all, print the table and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--data", type=Path, help="data folder (else $EPIPOLE_DATA, else ../shared/data)")
    arguments = parser.parse_args()
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    folder = data / "slam" / "euroc_static"
    rows = [
        summary_of("drawn motion", rendered(arguments.seeds, constant_velocity=False)),
        summary_of("constant velocity", rendered(arguments.seeds, constant_velocity=True)),
    ]
    if folder.is_dir():
        rows.append(summary_of("EuRoC V1_01, stretches of 15 s", euroc(folder, whole=False)))
        rows.append(summary_of("EuRoC V1_01, the whole flight", euroc(folder, whole=True)))
    tried, errors = tracked(RIDES)
    rows.append(summary_of("SLAM of the room with a unit", tried))
    table = Table(
        *("path", "tried", "refused", "within 2 sigma", "within 2 %", "largest", "median sigma", "s each")
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
    beside = float(np.median(errors[1:]))
    Console().print(
        f"error of the path in the room: {errors[0]:.2f} mm alone, {beside:.2f} mm with a unit (median)"
    )
    found = {
        "machine": describe_machine(1),
        "rows": rows,
        "slam_error_mm": {"alone": errors[0], "with": errors[1:]},
    }
    RESULTS.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
