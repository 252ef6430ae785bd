"""Every command line of README.md and of the pages under docs/ is run, block by block from the top, on small files of the kind it speaks of.

Nothing is left out. What would take minutes is shortened: trainings take four steps instead of a time, a circle of images has
three, the demo three photographs. Where a line serves pages the address that it prints is asked, and then Ctrl-C is pressed; the
camera at this computer is a stand-in that gives rendered images.
"""

import itertools
import os
import re
import shlex
import shutil
import signal
import sys
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from docs_pages import PAGES, command_blocks
from docs_ride import Capture
from docs_worlds import AFTER_RECONSTRUCTING, WORLDS

from epipole.cli.main import main
from epipole.lesson import command as lesson
from epipole.pipelines.slam import command as slam
from epipole.pipelines.slam.sources import streams as moving_sources
from epipole.pipelines.viewing import command as viewing
from whole import IS_WHOLE

BLOCKS = {
    f"{page}-{n}": lines for page, path in PAGES.items() for n, lines in enumerate(command_blocks(path))
}
TRAINING = ("splat", "nerf", "compare-fields")
MAKING = ("reconstruct", "slam", "stereo", *TRAINING)
"""Commands whose lines may be alternatives: an output folder of another source is refused by each."""
REPEATED = (
    "calibration-0",
    "coming_from/nerfstudio-1",
    "first_model-0",
    "first_model-1",
    "index-0",
)
"""Blocks whose commands, with the same options, others have; these run where all is tested."""
INTERRUPTED = 130
_ADDRESS = re.compile(r"(?:Viewer|Lesson) at (http://\S+)")


def shortened(line: str) -> list[str]:
    """The words to run, fewer steps and images."""
    words = shlex.split(re.sub(r" --(time|steps) \w+", "", line))[1:]
    if words[0] in TRAINING:
        words += ["--steps", "4"]
    if words[0] == "render" and "--cameras" not in words:
        words += ["--frames", "3"]
    return [*words, "--num-views", "3"] if words[0] == "demo" else words


@pytest.fixture
def requested(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Addresses that were printed and have answered; Ctrl-C follows."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    found: list[str] = []

    def said(text: str, *, to_stderr: bool = False) -> None:
        (sys.stderr if to_stderr else sys.stdout).write(f"{text}\n")
        if address := _ADDRESS.match(text):
            with urllib.request.urlopen(address[1], timeout=20) as answer:
                assert answer.status == 200 and answer.read()
            found.append(address[1])
            threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()

    for command in (viewing, lesson, slam):
        monkeypatch.setattr(command, "say", said)
    yield found
    signal.signal(signal.SIGINT, before)


def test_every_block_has_its_files() -> None:
    known = {*AFTER_RECONSTRUCTING, *WORLDS}
    assert known == set(BLOCKS), known ^ set(BLOCKS)


def test_repeated_blocks_hold_no_form_of_a_line_of_their_own() -> None:
    forms = {block: {form(line) for line in lines} for block, lines in BLOCKS.items()}
    others = set().union(*(forms[block] for block in BLOCKS if block not in REPEATED))
    for block in REPEATED:
        assert forms[block] <= others, f"{block}: {forms[block] - others}"


def form(line: str) -> tuple[str, ...]:
    """The command, and the names of its options."""
    _, command, *words = shlex.split(line)
    return command, *sorted(word for word in words if word.startswith("--"))


@pytest.mark.parametrize("block", [block for block in BLOCKS if IS_WHOLE or block not in REPEATED])
def test_command_lines_run(
    block: str,
    reconstructed: Path,
    tmp_path: Path,
    requested: list[str],
    monkeypatch: pytest.MonkeyPatch,
    unchecked: None,
) -> None:
    is_there = block in AFTER_RECONSTRUCTING
    folder = reconstructed if is_there else tmp_path
    (AFTER_RECONSTRUCTING if is_there else WORLDS)[block](folder)
    monkeypatch.chdir(folder)
    monkeypatch.setattr(moving_sources, "_opened_camera", lambda index: Capture())
    made: dict[str, list[str]] = {}
    for line in BLOCKS[block]:
        command, *words = shlex.split(line)[1:]
        named = list(itertools.takewhile(lambda word: not word.startswith("-"), words))
        if command in MAKING and named:
            job = [command, *named[:-1]]
            if made.setdefault(named[-1], job) != job:
                shutil.rmtree(named[-1])  # lines with one OUT are alternatives
                made[named[-1]] = job
        run(line, requested)


def run(line: str, requested: list[str]) -> None:
    """In this process; what a line refuses is a failure that tells why."""
    words, code, before = shortened(line), 0, len(requested)
    try:
        main(words)
    except SystemExit as stopped:
        code = int(stopped.code or 0)
    served = len(requested) > before
    assert code in ((0, INTERRUPTED) if served else (0,)), f"{line} ended with {code}"
    serves = words[0] in ("view", "lesson") and "--share" not in words and "--export" not in words
    assert served == (serves or (words[0] == "slam" and "--view" in words)), line
