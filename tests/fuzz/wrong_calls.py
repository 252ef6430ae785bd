"""Calls public functions with wrong arguments: `python -m tests.fuzz.wrong_calls --cases 20000 --seed 0`.

Only a result or an `EpipoleError` is right; any other exception, a crash, a call longer than 10 seconds and one that takes
more than a gigabyte are reported. The calls are made in a child process, which is started again after a crash.
"""

from __future__ import annotations

import argparse
import faulthandler
import json
import os
import re
import resource
import select
import subprocess
import sys
import tempfile
import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "tests")]

from valid_calls import Call, valid_calls  # noqa: E402 - a folder of tests, not a package
from wrong_arguments import describe, made, wrong_values  # noqa: E402

LIMIT_S = 10.0
LIMIT_BYTES = 1 << 30
_START_S = 300.0


@dataclass(frozen=True)
class Case:
    """A call with one or two wrong arguments."""

    call: Call
    wrong: dict[str, Any]

    def run(self) -> None:
        """Make the call; data classes among the arguments are made here, as they may be refused."""
        self.call.function(**self.call.arguments | {name: made(value) for name, value in self.wrong.items()})

    def __str__(self) -> str:
        return f"{self.call.name}({', '.join(f'{name}={describe(value)}' for name, value in self.wrong.items())})"


def calls_of(only: str) -> tuple[Call, ...]:
    """Those whose name matches a regular expression."""
    return tuple(call for call in valid_calls() if re.search(only, call.name))


def case(seed: int, number: int, calls: tuple[Call, ...] | None = None) -> Case:
    """The same for the same numbers."""
    random = Random(f"{seed} {number}")
    call = random.choice([call for call in calls or valid_calls() if call.arguments])
    names = random.sample(sorted(call.arguments), min(len(call.arguments), random.choice((1, 1, 1, 2))))
    wrong = {}
    for name in names:
        wrong[name] = random.choice(wrong_values(call.arguments[name], random))
    return Case(call, wrong)


def failure_of(one: Case) -> str | None:
    """What is wrong with the answer to a call; None where it is a result or an error of ours."""
    from epipole.errors import EpipoleError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            one.run()
    except EpipoleError:
        return None
    except Exception as error:  # noqa: BLE001 - every other exception is a finding
        position = next(
            (f for f in reversed(traceback.extract_tb(error.__traceback__)) if "epipole" in f.filename), None
        )
        at = f" at {Path(position.filename).name}:{position.lineno}" if position else ""
        return f"{type(error).__name__}: {str(error)[:120]}{at}"
    return None


def run_cases(numbers: range, seed: int, only: str = "") -> list[str]:
    """Findings of all cases, in child processes; each names its case."""
    findings, numbers_left, calls = [], numbers, calls_of(only)
    while numbers_left:
        with tempfile.TemporaryFile() as trace:
            last, found = _run_child(numbers_left, seed, trace, only)
            findings += found
            trace.seek(0)
            if last is None:
                break
            number, what = last
            text = trace.read().decode(errors="replace")
            where = [line.strip() for line in text.splitlines() if "epipole/" in line][:3]
            findings.append(f"{number}: {case(seed, number, calls)}: {what}; {' < '.join(where)}")
            numbers_left = range(number + 1, numbers.stop)
    return findings


def _run_child(numbers: range, seed: int, trace: Any, only: str) -> tuple[tuple[int, str] | None, list[str]]:
    """(the case that ended the child before its time, and how; findings)."""
    command = [sys.executable, __file__, "--child", "--seed", str(seed)]
    command += ["--first", str(numbers.start), "--cases", str(len(numbers)), "--only", only]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=trace, cwd=ROOT)
    assert child.stdout is not None
    at, findings, pending, limit_s = numbers.start, [], b"", _START_S
    while True:
        if not select.select([child.stdout], [], [], limit_s)[0]:
            child.kill()
            child.wait()
            return (at, f"longer than {limit_s:.0f} s"), findings
        read = os.read(child.stdout.fileno(), 1 << 16)
        if not read:
            break
        limit_s = LIMIT_S
        *lines, pending = (pending + read).split(b"\n")
        for line in lines:
            at, what = json.loads(line)
            if what:
                findings.append(f"{at}: {case(seed, at, calls_of(only))}: {what}")
    status = child.wait()
    return ((at, f"crash, exit code {status}") if status else None), findings


def _be_child(numbers: range, seed: int, only: str) -> None:
    """Make the calls, and write a line before each and one for each finding."""
    faulthandler.enable()
    calls = calls_of(only)
    for call in calls:  # loads the kernels: what comes after is the wrong calls' own time and memory
        failure_of(Case(call, {}))
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + LIMIT_BYTES, resource.RLIM_INFINITY))
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no finding
    os.chdir(tempfile.mkdtemp())  # a wrong argument may be a name to write to
    for number in numbers:
        print(json.dumps([number, None]), file=out, flush=True)
        what = failure_of(case(seed, number, calls))
        if what:
            print(json.dumps([number, what]), file=out, flush=True)


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="calls whose name matches this regular expression")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    numbers = range(arguments.first, arguments.first + arguments.cases)
    if arguments.child:
        _be_child(numbers, arguments.seed, arguments.only)
        return 0
    findings = run_cases(numbers, arguments.seed, arguments.only)
    sys.stdout.write("\n".join([*findings, f"{len(findings)} findings in {len(numbers)} calls", ""]))
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
