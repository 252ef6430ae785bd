"""A few of the file operations of jobs, and two runs at once; the modules themselves try as many as asked."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from whole import IS_WHOLE, in_whole_run

JOBS = (
    "ply",
    "stereo",
    *(("undistort", "calibrate", "transforms", "slam", "reconstruct") if IS_WHOLE else ()),
)
"""Transforms are a conversion, as a cloud of points is; killed and resumed runs of the longer two are tested with their own jobs."""
POINTS = 6 if IS_WHOLE else 2


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the trials fork")
def test_killed_and_out_of_space() -> None:
    printed = run("tests.fuzz.interruptions", "--job", *JOBS, "--points", str(POINTS))
    for job in JOBS:
        assert re.search(rf"^{job}: \d+ file operations, {POINTS} trials$", printed, re.MULTILINE), job


@in_whole_run
def test_two_at_once() -> None:
    assert "1 of 1 ended" in run("tests.fuzz.two_processes", "--times", "1")


def run(module: str, *arguments: str) -> str:
    """What the module prints; in a process without the threads of this one, for it forks."""
    command, root = [sys.executable, "-m", module, *arguments], Path(__file__).parents[2]
    done = subprocess.run(command, check=False, cwd=root, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
