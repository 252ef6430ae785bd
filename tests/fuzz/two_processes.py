"""Two runs with other options that start on one output folder at nearly the same time.

    python -m tests.fuzz.two_processes --times 50

Each must end in a model or in the sentence that another run works there, and what is left must be a model.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.fuzz.interruptions import JOBS

from epipole.io import read_colmap_model

WORKS_THERE = "another run of epipole"


def problems_of(folder: Path, out: Path, delay_s: float) -> list[str]:
    """What went wrong with two runs of which the second starts this much later."""
    command = [sys.executable, "-m", "epipole", "reconstruct", str(folder / "photographs"), str(out)]
    options = (["--matching.max-ratio", "0.8"], ["--matching.max-ratio", "0.75", "--threads", "1"])
    runs = []
    for own in options:
        runs.append(
            subprocess.Popen([*command, *own], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        )
        time.sleep(delay_s)
    given = [run.communicate(timeout=300)[1] for run in runs]
    problems = [
        f"a run ended with {run.returncode}: {text[-2000:]}"
        for run, text in zip(runs, given)
        if run.returncode != 0 and not (run.returncode == 1 and WORKS_THERE in text)
    ]
    if all(run.returncode != 0 for run in runs):
        problems.append("neither made a model")
    elif len(read_colmap_model(out / "sparse" / "0").images) < 3:
        problems.append("what is left is no model")
    return problems


def main() -> None:
    """Try it as many times as asked, with chosen delays."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--times", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    chance, num_wrong = random.Random(given.seed), 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        JOBS["reconstruct"].prepare(folder)
        for number in range(given.times):
            found = problems_of(folder, folder / f"out{number}", chance.choice((0.0, 0.05, 0.3, 1.0, 2.5)))
            num_wrong += bool(found)
            for problem in found:
                print(f"{number}: {problem}", flush=True)
    print(f"{given.times - num_wrong} of {given.times} ended as they should")
    sys.exit(1 if num_wrong else 0)


if __name__ == "__main__":
    main()
