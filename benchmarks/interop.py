"""Whether COLMAP can continue from epipole's output: `python -m benchmarks.interop`.

epipole reconstructs each set. Then pycolmap, in its own process, reads and adjusts the model and maps from the database.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.peers.base import Limits
from benchmarks.peers.epipole_sfm import EpipoleSfm
from benchmarks.tasks.sfm import SETS, data_root, prepare


def run_set(name: str, data: Path) -> dict[str, Any]:
    """Reconstruct the set with epipole, then run pycolmap on the output.

    Raises:
        subprocess.CalledProcessError: one of the programs failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        out, result = Path(folder) / "out", Path(folder) / "result.json"
        task = prepare(name, data, Path(folder))
        command = EpipoleSfm().command(task, out, Limits())
        subprocess.run(command, cwd=REPOSITORY, check=True, capture_output=True)
        command = [sys.executable, "-m", "benchmarks.peers.pycolmap_reads", str(out), str(result)]
        subprocess.run(command, cwd=REPOSITORY, check=True, capture_output=True)
        summary = json.loads((out / "summary.json").read_text())
        ours = {
            key: summary[key] for key in ("num_images", "num_registered", "num_points", "num_observations")
        }
        return {"set": name, "epipole": ours, "pycolmap": json.loads(result.read_text())}


def main() -> None:
    """Run the sets, print the table and write the results."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--set", nargs="+", default=list(SETS), choices=list(SETS))
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    columns = (
        "set",
        "registered",
        "points, observations read",
        "cost reduction by its adjustment",
        "images mapped from the database",
    )
    table = Table(*columns)
    rows = []
    for name in arguments.set:
        row = run_set(name, data_root(arguments.data))
        ours, theirs = row["epipole"], row["pycolmap"]
        with_free_intrinsics = theirs["adjusted_with_lenses"]
        same = ours["num_points"] == theirs["read"]["points"]
        same &= ours["num_observations"] == theirs["read"]["observations"]
        table.add_row(
            name,
            f"{ours['num_registered']} of {ours['num_images']}",
            f"{theirs['read']['points']}, {theirs['read']['observations']} ({'the same' if same else 'NOT the same'})",
            f"{theirs['adjusted']['gain']:.1e}"
            + (f"; free intrinsics {with_free_intrinsics['gain']:.1e}" if with_free_intrinsics else ""),
            str(theirs["mapped"]["models"]),
        )
        rows.append(row)
    Console().print(table)
    arguments.results.mkdir(parents=True, exist_ok=True)
    report = {"machine": describe_machine(2), "rows": rows}
    (arguments.results / "interop.json").write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
