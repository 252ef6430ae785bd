"""Whether an IMU's scale lies where it is said to lie. `python -m benchmarks.inertial`.

Drawn motions of a hand-held unit (50 seeds), the same at constant velocity, which must be refused, and stretches of EuRoC's real
unit with the true path of its drone.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from epipole.errors import DegenerateGeometryError
from epipole.geometry import Rigid3, Rotation3
from epipole.inertial import align_path_to_imu
from epipole.io.imu_logs import read_imu
from epipole.mapping import fit_scale_to_imu
from epipole.synthetic.inertial import inertial_path

RESULTS = REPOSITORY / "benchmarks" / "results" / "inertial.json"
STRETCH_S, UNIT = 15.0, 2.5
"""Length of EuRoC's stretches, and the metres of a unit that nobody is told."""

Tried = tuple[float, float, float] | None
"""True scale, found, and its deviation; None for refused."""


def drawn(count: int, *, constant_velocity: bool) -> Iterator[Tried]:
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
        yield UNIT, one.scale, one.scale * one.share
        return
    for begin in np.arange(times[0], times[-1] - STRETCH_S, 5.0):
        own = np.flatnonzero((times >= begin) & (times < begin + STRETCH_S))
        try:
            found = align_path_to_imu(times[own], path[own], log, Rigid3.identity(), noise)
        except DegenerateGeometryError:
            yield None
        else:
            yield UNIT, found.scale, found.sigma


def summary_of(name: str, tried: Iterator[Tried]) -> dict[str, Any]:
    """Counts and shares."""
    begin, all_tried = time.perf_counter(), list(tried)
    told = np.array([one for one in all_tried if one is not None]).reshape(-1, 3)
    off, share = told[:, 1] / told[:, 0] - 1.0, told[:, 2] / told[:, 1]
    return {
        "name": name,
        "tried": len(all_tried),
        "refused": len(all_tried) - len(told),
        "within_2_sigma": float((np.abs(off) <= 2 * share).mean()) if len(told) else None,
        "within_2_percent": float((np.abs(off) <= 0.02).mean()) if len(told) else None,
        "largest_error": float(np.abs(off).max()) if len(told) else None,
        "median_sigma": float(np.median(share)) if len(told) else None,
        "seconds_each": (time.perf_counter() - begin) / max(len(all_tried), 1),
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
        summary_of("drawn motion", drawn(arguments.seeds, constant_velocity=False)),
        summary_of("constant velocity", drawn(arguments.seeds, constant_velocity=True)),
    ]
    if folder.is_dir():
        rows.append(summary_of("EuRoC V1_01, stretches of 15 s", euroc(folder, whole=False)))
        rows.append(summary_of("EuRoC V1_01, the whole flight", euroc(folder, whole=True)))
    table = Table(
        *("path", "tried", "refused", "within 2 sigma", "within 2 %", "largest", "median sigma", "s each")
    )
    for row in rows:
        shares = [row[key] for key in ("within_2_sigma", "within_2_percent", "largest_error", "median_sigma")]
        words = ["-" if share is None else f"{100 * share:.3g} %" for share in shares]
        table.add_row(
            row["name"], str(row["tried"]), str(row["refused"]), *words, f"{row['seconds_each']:.2f}"
        )
    Console().print(table)
    RESULTS.write_text(json.dumps({"machine": describe_machine(1), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
