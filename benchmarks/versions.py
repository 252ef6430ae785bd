"""Time of epipole's commands compared with another version: `python -m benchmarks.versions --other CHECKOUT`.

CHECKOUT contains the other version's `src` (`git worktree add`). Both versions run in turn in this environment, after a warm-up.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY

JOBS = {
    "fountain": ("reconstruct", "DATA/sfm/fountain-P11/images", "OUT"),
    "kitti06": ("slam", "DATA/slam/kitti06_stereo", "OUT"),
    "kitchen": ("slam", "DATA/slam/7scenes", "OUT"),
    "splat": ("splat", "MODEL", "OUT", "--steps", "200"),
    "aloe": ("stereo", "DATA/stereo/aloe/aloeL.jpg", "DATA/stereo/aloe/aloeR.jpg", "OUT"),
}
"""Arguments of the commands; OUT is a new folder, MODEL this version's reconstruction of fountain-P11."""


def timed(checkout: Path, job: tuple[str, ...], data: Path, model: Path) -> tuple[float, float]:
    """Wall time and processor time of a command in seconds.

    Raises:
        SystemExit: the command fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        words = [w.replace("DATA", str(data)) for w in job]
        words = [{"OUT": f"{folder}/out", "MODEL": str(model)}.get(w, w) for w in words]
        before, start = os.times(), time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-m", "epipole", *words],
            env=os.environ | {"PYTHONPATH": str(checkout / "src")},
            capture_output=True,
            text=True,
            check=False,
        )
        wall, after = time.perf_counter() - start, os.times()
    if done.returncode:
        raise SystemExit(f"{' '.join(words)} of {checkout} failed: {done.stderr[-500:]}")
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return wall, used


def main() -> None:
    """Run both versions in turn and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--other", type=Path, required=True, help="checkout of the other version")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--job", nargs="+", choices=list(JOBS), default=list(JOBS))
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    arguments = parser.parse_args()
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    both = {"this": REPOSITORY, "other": arguments.other.resolve()}
    table = Table(title=f"this version over {arguments.other}, medians of {arguments.pairs} pairs")
    for column in ("job", "this, s", "other, s", "wall, ratio", "CPU, ratio", "range"):
        table.add_column(column, justify="right")
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "model"
        command = ("reconstruct", str(data / "sfm" / "fountain-P11" / "images"), str(model))
        timed(REPOSITORY, command, data, model)
        for name in arguments.job:
            for checkout in both.values():
                timed(checkout, JOBS[name], data, model)
            rows = []
            for k in range(arguments.pairs):
                order = list(both) if k % 2 else list(both)[::-1]
                rows.append({who: timed(both[who], JOBS[name], data, model) for who in order})
            ratios = [[row["this"][i] / row["other"][i] for row in rows] for i in (0, 1)]
            table.add_row(
                name,
                *(f"{statistics.median(row[who][0] for row in rows):.2f}" for who in both),
                *(f"{statistics.median(r):.3f}" for r in ratios),
                f"{min(ratios[0]):.3f} to {max(ratios[0]):.3f}",
            )
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
