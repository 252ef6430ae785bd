"""A few of the file operations of every job; `python -m tests.fuzz.interruptions` tries them all."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the trials fork")
@pytest.mark.parametrize("jobs", [("reconstruct", "ply"), ("undistort", "transforms", "stereo")])
def test_killed_and_out_of_space(jobs: tuple[str, ...]) -> None:
    command = [sys.executable, "-m", "tests.fuzz.interruptions", "--every", "41", "--job", *jobs]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, check=False, cwd=root, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stdout + done.stderr
    assert all(f"{job}: " in done.stdout for job in jobs)
