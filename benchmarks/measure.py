"""Wall time and peak memory of a program with its child processes, and a description of the machine."""

from __future__ import annotations

import math
import os
import platform
import subprocess
import sys
import time
from dataclasses import dataclass
from importlib import metadata, util
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
_SAMPLE_EVERY_S = 0.05


@dataclass(frozen=True, slots=True)
class ProcessMeasure:
    """Time and memory of one run of a program."""

    exit_code: int
    wall_s: float
    peak_memory_mb: float | None
    """Largest resident memory of the process tree, sampled 20 times a second; None without psutil."""


def run_measured(
    command: list[str], log: Path, num_threads: int, limit_s: float = math.inf
) -> ProcessMeasure:
    """Run a command from the root of the repository with its libraries limited to `num_threads`, and write its output to `log`.

    The command is killed after `limit_s` seconds.
    """
    threads = {name: str(num_threads) for name in ("EPIPOLE_NUM_THREADS", "OMP_NUM_THREADS")}
    blas = {name: str(num_threads) for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("wb") as stream:
        start, peak = time.perf_counter(), 0
        process = subprocess.Popen(
            command,
            cwd=REPOSITORY,
            env={**os.environ, **threads, **blas},
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
        )
        while True:
            peak = max(peak, _tree_memory(process.pid))
            if time.perf_counter() - start > limit_s:
                process.kill()
            try:
                exit_code = process.wait(_SAMPLE_EVERY_S)
                break
            except subprocess.TimeoutExpired:
                continue
        wall_s = time.perf_counter() - start
    return ProcessMeasure(exit_code, wall_s, peak / 2**20 if peak else None)


def _tree_memory(pid: int) -> int:
    """Resident bytes of a process and its descendants; 0 if it has ended or psutil is not installed."""
    if util.find_spec("psutil") is None:
        return 0
    import psutil

    total = 0
    try:
        process = psutil.Process(pid)
        for member in (process, *process.children(recursive=True)):
            total += member.memory_info().rss
    except psutil.Error:
        return total
    return total


def describe_machine(num_threads: int) -> dict[str, object]:
    """The machine, the Python interpreter, package versions and the commit of the repository."""
    return {
        "cpu": _cpu_name(),
        "cpus_usable": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "threads": num_threads,
        "load_average": os.getloadavg() if hasattr(os, "getloadavg") else None,
        "platform": platform.platform(),
        "python": sys.version.split()[0],
        "versions": {name: _version(name) for name in ("numpy", "scipy", "numba", "opencv-python-headless")},
        "commit": _commit(),
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _commit() -> str:
    """The commit, with "+" appended if the working tree has changes; "unknown" outside a git checkout."""
    try:
        commit, changes = (
            subprocess.run(["git", *words], cwd=REPOSITORY, check=True, capture_output=True, text=True).stdout
            for words in (["rev-parse", "HEAD"], ["status", "--porcelain"])
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return commit.strip() + ("+" if changes.strip() else "")
