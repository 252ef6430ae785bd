"""The command lines of README.md and of the pages under docs/.

Every line is read by the real command line: its command, its options and the types of their values are right, and the job is not run.
The lines of `JOBS` are really run as well, each group in order in one small folder (its pictures are rendered; Gaussians are trained for
twenty steps), and must end without an error; only these lines are shown to work on files. What is read alone needs minutes
(`splat`, `nerf`, `compare-fields`), a camera, a recording, or does not end (`view`).
"""

import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from docs_pages import PAGES, commands_of
from docs_setups import PREPARED, ride_folder

import epipole
from epipole.cli import main as command_line
from epipole.io import write_trajectory
from epipole.scene import Trajectory

LINES = {line: page for page, path in PAGES.items() for line in commands_of(path)}
"""Each line once, and a page on which it stands."""


@pytest.fixture(scope="module")
def functions() -> dict[str, Callable[..., None]]:
    return command_line._functions()


@pytest.mark.parametrize("line", LINES)
def test_command_lines_can_be_read(
    line: str, functions: dict[str, Callable[..., None]], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = line.split()[1:]
    asked = (
        "stereo-doctor"
        if words[:2] == ["stereo", "doctor"]
        else next((w for w in words if w in functions), "")
    )
    # The parser is made of the commands anew for each line: of this one and of one other it is made ten times as fast.
    known = {name: functions[name] for name in (asked or "demo", "version")}
    monkeypatch.setattr(command_line, "_functions", lambda: known)
    run = []
    real = command_line._parsed
    monkeypatch.setattr(command_line, "_parsed", lambda words: real(words) and (lambda: run.append(words)))
    read(line)
    assert run or "--help" in line or words in (["help"], ["--version"])


def read(line: str) -> None:
    """Run a line in this process; what it refuses is a failure that tells why."""
    try:
        command_line.main(shlex.split(line)[1:])
    except SystemExit as stopped:
        assert not stopped.code, f"{line} (on the page {LINES[line]}) ended with {stopped.code}"


def pair_files(folder: Path) -> None:
    PREPARED["stereo"](folder)
    (folder / "calibration.json").rename(folder / "FILE")
    PREPARED["calibration"](folder)
    (folder / "IMAGES").rename(folder / "BOARDS")


def path_files(folder: Path) -> None:
    ride_folder(folder / "SOURCE", 12)
    path = Trajectory(0.1 * np.arange(12), epipole.Rigid3.exp(0.1 * np.arange(72.0).reshape(12, 6) / 12))
    for name in ("PATH.txt", "TRUTH.txt"):
        write_trajectory(path, folder / name, "tum")


def field_files(folder: Path) -> None:
    PREPARED["fields"](folder)
    epipole.splat(folder / "MODEL", folder / "OUT", steps=20, max_gaussians=500)


JOBS: dict[str, tuple[Callable[[Path], None] | None, tuple[str, ...]]] = {
    "a model": (
        None,  # where the reconstruction is that all tests share
        (
            "epipole version",
            "epipole reconstruct IMAGES OUT",
            "epipole evaluate OUT --truth DIR",
            "epipole undistort OUT",
            "epipole convert OUT TARGET --format transforms",
            "epipole convert OUT cloud.ply",
        ),
    ),
    "a pair": (
        pair_files,
        (
            "epipole calibrate BOARDS CAL --columns 9 --rows 6 --square 0.025",
            "epipole stereo doctor LEFT RIGHT --focal-px 800 --baseline 0.12",
            "epipole stereo LEFT RIGHT OUT",
            "epipole stereo LEFT RIGHT OUT --focal-px 800 --baseline 0.12",
        ),
    ),
    "a path": (
        path_files,
        (
            "epipole evaluate PATH.txt --truth TRUTH.txt",
            "epipole slam SOURCE OUT",
            "epipole slam SOURCE OUT --resume",
        ),
    ),
    "a field": (
        field_files,
        (
            "epipole convert OUT small.spz",
            "epipole view OUT --share page.html",
            "epipole mesh OUT mesh.ply",
        ),
    ),
}


@pytest.mark.parametrize("job", JOBS)
def test_quick_commands_run(
    job: str, reconstructed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unchecked: None
) -> None:
    prepare, lines = JOBS[job]
    folder = tmp_path if prepare else reconstructed
    if prepare:
        prepare(folder)
    monkeypatch.chdir(folder)
    for line in lines:
        assert line in LINES, f"{line} stands on no page"
        read(line)
