"""Time of the first call of each public estimator, without compiled kernels: `python -m benchmarks.compile_times`.

Each estimator runs in its own process with an empty kernel folder; the second call shows the time without compilation.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine

PREPARE = """
import time
import numpy as np
from epipole.robust import *
from epipole.synthetic.problems import absolute_pose_problem, two_view_problem
p, a = two_view_problem(200, 0.2, 0.5), absolute_pose_problem(200, 0.2, 0.5)
c, center = p.camera1, (639.5, 479.5)
def timed(call):
    out = []
    for _ in range(2):
        start = time.perf_counter()
        call()
        out.append(time.perf_counter() - start)
    print(out)
"""
CALLS = {
    "estimate_homography": "estimate_homography(p.pixels1, p.pixels2)",
    "estimate_fundamental_matrix": "estimate_fundamental_matrix(p.pixels1, p.pixels2)",
    "estimate_relative_pose": "estimate_relative_pose(p.pixels1, p.pixels2, c, c)",
    "estimate_upright_motion": "estimate_upright_motion(p.pixels1, p.pixels2, c, c, ((0, 1, 0), (0, 1, 0)))",
    "estimate_motion_and_shared_focal": "estimate_motion_and_shared_focal(p.pixels1, p.pixels2, center)",
    "estimate_motion_and_focals": "estimate_motion_and_focals(p.pixels1, p.pixels2, center, center)",
    "estimate_absolute_pose": "estimate_absolute_pose(a.points_in_world, a.pixels, c)",
    "estimate_upright_pose": "estimate_upright_pose(a.points_in_world, a.pixels, c, (0, 1, 0))",
    "estimate_pose_and_focal": "estimate_pose_and_focal(a.points_in_world, a.pixels, center)",
    "estimate_rigid": "estimate_rigid(a.points_in_world, a.points_in_world)",
    "triangulate_points": "triangulate_points(a.cam_from_world[None][[0, 0]], c, np.stack([p.pixels1, p.pixels2]))",
    "verify_pair": "verify_pair(p.pixels1, p.pixels2, c, c, is_calibrated=True)",
}


def first_and_second_call(call: str) -> list[float]:
    """Seconds of two calls in a new process with an empty kernel folder."""
    with tempfile.TemporaryDirectory() as folder:
        code = f"{PREPARE}\ntimed(lambda: {call})"
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "EPIPOLE_CACHE_DIR": folder},
            capture_output=True,
            text=True,
            check=True,
        )
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Time every estimator, print the table and write the results."""
    table = Table(title="first call without compiled kernels")
    for column in ("estimator", "first call (s)", "second call (ms)"):
        table.add_column(column, justify="right")
    report: dict[str, object] = {"machine": describe_machine(1)}
    for name, call in CALLS.items():
        first, second = first_and_second_call(call)
        report[name] = {"first_s": first, "second_s": second}
        table.add_row(name, f"{first:.1f}", f"{1e3 * second:.2f}")
    file = Path(REPOSITORY) / "benchmarks" / "results" / "compile_times.json"
    file.write_text(json.dumps(report, indent=1) + "\n")
    Console().print(table)


if __name__ == "__main__":
    main()
