"""Every command line of README.md and of the pages under docs/ is parsed, and run block by block on small files of the kind it names.

Each run takes a sample of the blocks, the whole run all of them. What would take minutes is shortened: trainings take four steps
instead of a time, a circle of images has three, the demo three photographs. Where a line serves pages the address that it prints is
asked, and then Ctrl-C is pressed; the camera at this computer is a stand-in that gives rendered images.
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

from epipole.cli import main as command_line
from epipole.cli.main import main
from epipole.lesson import command as lesson
from epipole.pipelines.slam import command as slam
from epipole.pipelines.slam.sources import live_cameras
from epipole.pipelines.viewing import command as viewing
from whole import IS_WHOLE

BLOCKS = {
    f"{page}-{n}": lines for page, path in PAGES.items() for n, lines in enumerate(command_blocks(path))
}
TRAINING = ("splat", "nerf", "compare-fields")
MAKING = ("reconstruct", "slam", "stereo", *TRAINING)
"""Commands whose lines may be alternatives: an output folder of another source is refused by each."""
DAILY = (
    "README-0",
    "README-4",
    "calibration-1",
    "command_line-0",
    "command_line-1",
    "first_model-2",
    "install-0",
    "install-1",
    "install-2",
)
"""Blocks that every run executes: of the others the tests of each job run the same options."""
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


@pytest.mark.parametrize("block", BLOCKS)
def test_command_lines_are_parsed(block: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands, options and their values are those of the command line, which then runs nothing."""
    parsed = command_line._parsed
    monkeypatch.setattr(command_line, "_parsed", lambda words: parsed(words) and (lambda: None))
    for line in BLOCKS[block]:
        assert exit_code(shlex.split(line)[1:]) == 0, line


def exit_code(words: list[str]) -> int:
    """Of a command line, run in this process."""
    try:
        main(words)
    except SystemExit as stopped:
        return int(stopped.code or 0)
    return 0


@pytest.mark.parametrize("block", BLOCKS if IS_WHOLE else DAILY)
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
    monkeypatch.setattr(live_cameras, "_opened_camera", lambda index: Capture())
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
    words, before = shortened(line), len(requested)
    code = exit_code(words)
    served = len(requested) > before
    assert code in ((0, INTERRUPTED) if served else (0,)), f"{line} ended with {code}"
    serves = words[0] in ("view", "lesson") and "--share" not in words and "--export" not in words
    assert served == (serves or (words[0] == "slam" and "--view" in words)), line
