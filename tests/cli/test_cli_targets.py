"""No command changes anything of the user's that stands at its target, whatever that is."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from cli_targets import EXISTING, MAY_SUCCEED, PAGE, TARGETS, Target, make_inputs, mine, snapshot

from epipole.cli import main as command_line
from epipole.cli.main import main
from pairwise import each_once
from whole import IS_WHOLE

CASES = [pytest.param(t, id=t.words.replace("OUT", t.name)) for all_of in TARGETS.values() for t in all_of]
FILES = [case for case in CASES if case.values[0].is_file]
FOLDERS = [case for case in CASES if not case.values[0].is_file]

pytestmark = [
    pytest.mark.skipif(os.name == "nt", reason="links, pipes and sockets"),
    pytest.mark.usefixtures("unchecked_module"),
]
NO_FOLDERS = [
    target for target in (case.values[0] for case in FOLDERS) if target.source or "demo" in target.words
]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("inputs")
    make_inputs(root)
    return root


@pytest.fixture
def work(inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the inputs, in which commands run."""
    shutil.copytree(inputs, tmp_path / "work")
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


def run(target: Target, out: str, *more: str) -> int:
    """The exit code."""
    try:
        main([out if word == "OUT" else word for word in target.words.split()] + [*more])
    except SystemExit as stopped:
        return int(stopped.code or 0)
    return 0


def test_every_command_has_its_targets_listed() -> None:
    assert set(TARGETS) == set(command_line._functions())
    assert {name for name, targets in TARGETS.items() if not targets} == set(command_line.WRITING_NOTHING)


@pytest.mark.parametrize("target", CASES)
def test_what_is_there_stays_as_it_is(target: Target, work: Path, tmp_path: Path, capfd) -> None:
    row = [case.values[0] for case in CASES].index(target)
    for number, (what, make) in enumerate(EXISTING.items()):
        if not IS_WHOLE and (row + number) % 5:
            continue
        own = tmp_path / f"{number}"
        own.mkdir()
        make(own / target.name)
        before = snapshot(tmp_path)
        code = run(target, str(own / target.name))
        after = snapshot(tmp_path)
        assert {name: after.get(name) for name in before} == before, what
        may_succeed = what in MAY_SUCCEED and (target.is_file or target.words.startswith("lesson"))
        if not may_succeed:
            assert code in (1, 2) and after == before, what
            assert "epipole: " in capfd.readouterr().err


@pytest.mark.parametrize("target", [case for case in CASES if case.values[0].source])
def test_inputs_are_never_replaced(target: Target, work: Path) -> None:
    """Not even if the user asks."""
    for out in (target.source, f"./{target.source}", f"{work}/{target.source}"):
        for more in ((), ("--overwrite",)):
            before = snapshot(work)
            code = run(target, out, *more)
            assert code in (1, 2) and snapshot(work) == before


@pytest.mark.parametrize("target", FILES)
def test_a_file_of_ours_is_replaced_until_somebody_changes_it(target: Target, work: Path) -> None:
    out, is_sealed = Path(target.name), not target.name.endswith(".splat")
    assert run(target, target.name) == 0
    assert run(target, target.name) == (0 if is_sealed else 1)
    written = out.read_bytes()
    for number in (len(written) // 2, len(written) - 1):
        changed = written[:number] + bytes([written[number] ^ 1]) + written[number + 1 :]
        out.write_bytes(changed)
        assert run(target, target.name) == 1 and out.read_bytes() == changed
    out.write_bytes(written + b"\n")
    assert run(target, target.name) == 1
    mine(out)
    assert run(target, target.name, "--overwrite") == 0 and out.read_bytes() == written


def test_a_file_of_another_command_is_not_ours(work: Path) -> None:
    first, second = TARGETS["mesh"][0], TARGETS["convert"][4]
    assert run(first, "scene.ply") == 0
    written = Path("scene.ply").read_bytes()
    assert run(second, "scene.ply") == 1 and Path("scene.ply").read_bytes() == written


def test_one_page_of_the_user_keeps_all_pages_of_the_lesson_away(work: Path) -> None:
    target = TARGETS["lesson"][0]
    assert run(target, "out") == 0 and run(target, "out") == 0
    mine(Path("out") / PAGE)
    before = snapshot(work)
    assert run(target, "out") == 1 and snapshot(work) == before
    assert run(target, "out", "--overwrite") == 0
    assert snapshot(work) != before


def test_overwriting_a_folder_replaces_files_of_the_results_names_alone(work: Path) -> None:
    target = TARGETS["convert"][0]
    out = Path("out")
    out.mkdir()
    for name in ("cameras.txt", "notes.txt"):
        mine(out / name)
    assert run(target, "out") == 1
    assert run(target, "out", "--overwrite") == 0
    assert (out / "notes.txt").read_bytes() == b"mine" and b"SIMPLE_RADIAL" in (
        out / "cameras.txt"
    ).read_bytes()
    before = (out / "notes.txt").read_bytes()
    assert run(TARGETS["render"][1], "out") == 1
    assert run(TARGETS["render"][1], "out", "--overwrite") == 0
    assert not (out / "cameras.txt").exists() and (out / "notes.txt").read_bytes() == before


@pytest.mark.parametrize(
    ("target", "name"), each_once(NO_FOLDERS, ["out.mov", "out.GIF", "out.ply", "out.json", "out.zip"])
)
def test_no_folder_is_made_under_the_name_of_a_file(target: Target, name: str, work: Path) -> None:
    before = snapshot(work)
    assert run(target, name) in (1, 2) and snapshot(work) == before


@pytest.mark.parametrize("name", ["out.webm", "out.xyz", "out.MP3", "a.b.mp44"])
def test_a_render_is_a_video_or_a_folder(name: str, work: Path, capsys) -> None:
    assert run(TARGETS["render"][1], name) == 2 and not Path(name).exists()
    assert ".gif, or a folder" in capsys.readouterr().err
    assert run(TARGETS["render"][1], "views_0.5") == 0 and Path("views_0.5").is_dir()


@pytest.mark.parametrize("name", command_line.WRITING_NOTHING)
def test_overwrite_is_refused_where_nothing_is_written(name: str, capsys) -> None:
    with pytest.raises(SystemExit) as stopped:
        main([name, "--overwrite"])
    assert stopped.value.code == 2 and "writes no files" in capsys.readouterr().err
