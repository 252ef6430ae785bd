"""Damaged files of every format, read in processes that may crash or hang: `python -m tests.fuzz.run --cases 10000`.

What is found is printed with the command that repeats it: `--format NAME --seed N --case K`, to which `--keep FOLDER`
leaves the file.
"""

import argparse
import json
import math
import os
import select
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

HERE = Path(__file__).resolve().parent
WALL_SECONDS = 30.0
"""A process that says nothing for so long hangs."""
PREPARING_SECONDS = 300.0
"""The same where examples are written first, for which kernels are compiled."""


@dataclass(frozen=True)
class Finding:
    """A file that was read wrongly."""

    format: str
    seed: int
    case: int
    problem: str

    def __str__(self) -> str:
        again = f"python -m tests.fuzz.run --format '{self.format}' --seed {self.seed} --case {self.case}"
        return f"{again}\n{self.problem}"


def _worker(*options: str, report: int | None = None, stderr: object = None) -> subprocess.Popen:
    folders = [
        HERE.parents[1] / "src",
        HERE.parent,
        *(HERE.parent / room for room in ("io", "fields", "sfm", "slam")),
    ]
    quiet = {"OPENCV_LOG_LEVEL": "SILENT", "OPENCV_FFMPEG_LOGLEVEL": "-8", "MALLOC_ARENA_MAX": "2"} | {
        "MALLOC_MMAP_THRESHOLD_": "131072"
    }
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    env = os.environ | quiet | one | {"PYTHONPATH": os.pathsep.join(map(str, folders))}
    env |= {} if report is None else {"FUZZ_REPORT": str(report)}
    return subprocess.Popen(
        [sys.executable, str(HERE / "worker.py"), *options],
        **{"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": stderr, "env": env},
        pass_fds=() if report is None else (report,),
    )


@cache
def formats() -> dict[str, tuple[float, list[str]]]:
    """Share and readers of every format."""
    out, _ = _worker("--list").communicate()
    return {name: (weight, readers) for name, (weight, readers) in json.loads(out).items()}


def _read_lines(source: int, timeout_s: float) -> list[str] | None:
    """What the process has said since; None where it hangs, [] where it has ended."""
    ready, _, _ = select.select([source], [], [], timeout_s)
    if not ready:
        return None
    data = os.read(source, 1 << 16)
    while data and not data.endswith(b"\n"):
        more = os.read(source, 1 << 16)
        data = data + more if more else b""
    return data.decode().splitlines()


def _one_process(tasks: list[list], keep: Path | None) -> tuple[list[Finding], list[list]]:
    """What a process finds, and what it leaves undone where it does not come to its end."""
    source, report = os.pipe()
    seeds = {name: seed for name, seed, *_ in tasks}
    options = ("--keep", str(keep)) if keep else ()
    with tempfile.TemporaryFile() as stderr:
        worker = _worker(*options, report=report, stderr=stderr)
        os.close(report)
        worker.stdin.write("".join(json.dumps(task) + "\n" for task in tasks).encode())
        worker.stdin.close()
        found, last, hangs = [], ("nothing", -1), False
        while lines := _read_lines(source, WALL_SECONDS if last[0] == "begin" else PREPARING_SECONDS) or []:
            for line in lines:
                what, name, case, *rest = line.split(" ", 3)
                last = (what if what != "wrong" else "begin", (name, int(case)))
                if what == "wrong":
                    found.append(Finding(name, seeds[name], int(case), json.loads(rest[0])))
        os.close(source)
        if last[0] == "end":
            worker.wait()
            return found, []
        hangs = worker.poll() is None and not _ended(worker)
        worker.kill()
        worker.wait()
        stderr.seek(0)
        said = stderr.read().decode(errors="replace")[-2000:]
    if last[0] != "begin":
        raise RuntimeError(f"no case was begun ({last}):\n{said}")
    name, case = last[1]
    how = "hangs" if hangs else f"dies of {_signal_name(worker.returncode)}"
    found.append(Finding(name, seeds[name], case, f"the process {how}:\n{said}"))
    at = next(k for k, task in enumerate(tasks) if task[0] == name)
    return found, [[name, seeds[name], case + 1, tasks[at][3]], *tasks[at + 1 :]]


def _ended(worker: subprocess.Popen) -> bool:
    try:
        worker.wait(2)
    except subprocess.TimeoutExpired:
        return False
    return True


def _signal_name(code: int) -> str:
    return signal.Signals(-code).name if code < 0 else f"exit code {code}"


def search(tasks: list[list], keep: Path | None = None) -> list[Finding]:
    """Read the files of all tasks: (format, seed, first case, last case + 1), a format once."""
    found: list[Finding] = []
    while tasks:
        more, tasks = _one_process(tasks, keep)
        found += more
    return found


def tasks_of(cases: int, seed: int, only: str | None = None) -> list[list]:
    """So many cases at least, shared out to the formats."""
    known = {name: weight for name, (weight, _) in formats().items() if only in (None, name)}
    total = sum(known.values())
    return [[name, seed, 0, math.ceil(cases * weight / total)] for name, weight in known.items()]


def main() -> int:
    """Print what was found; the exit code is 1 where that is anything."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=10000, help="files in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--format", help="of these files only")
    parser.add_argument("--case", type=int, help="this file only (with --format)")
    parser.add_argument("--keep", type=Path, help="a new folder for the files (with --case)")
    given = parser.parse_args()
    if given.case is not None:
        tasks = [[given.format, given.seed, given.case, given.case + 1]]
    else:
        tasks = tasks_of(given.cases, given.seed, given.format)
    if given.keep:
        given.keep.mkdir(parents=True)
    found = search(tasks, given.keep)
    for finding in found:
        sys.stdout.write(f"{finding}\n\n")
    total = sum(stop - first for _, _, first, stop in tasks)
    sys.stdout.write(f"{total} files of {len(tasks)} formats, {len(found)} read wrongly\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
