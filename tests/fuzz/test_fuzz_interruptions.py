"""A few of the file operations of every job, and two runs at once; the modules themselves try as many as asked."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the trials fork")
@pytest.mark.parametrize(
    ("every", "jobs"),
    [
        ("1", ("ply",)),
        ("47", ("calibrate",)),
        ("83", ("slam",)),
        ("149", ("reconstruct", "undistort", "transforms", "stereo")),
    ],
)
def test_killed_and_out_of_space(every: str, jobs: tuple[str, ...]) -> None:
    printed = run("tests.fuzz.interruptions", "--every", every, "--job", *jobs)
    assert all(f"{job}: " in printed for job in jobs)


def test_two_at_once() -> None:
    assert "1 of 1 ended" in run("tests.fuzz.two_processes", "--times", "1")


def run(module: str, *arguments: str) -> str:
    """What the module prints; in a process without the threads of this one, for it forks."""
    command, root = [sys.executable, "-m", module, *arguments], Path(__file__).parents[2]
    done = subprocess.run(command, check=False, cwd=root, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
