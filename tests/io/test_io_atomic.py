"""Files and folders appear whole or not at all."""

import os
import re
import stat
from pathlib import Path

import pytest

from epipole.errors import ConfigError, WorkspaceError
from epipole.io import atomic_folder, atomic_write
from epipole.io.atomic import part_beside, remove_abandoned_parts, remove_abandoned_parts_below


def names_in(folder: Path) -> list[str]:
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*"))


def test_a_file_appears_whole_and_alone(tmp_path: Path) -> None:
    target = tmp_path / "new" / "points.ply"
    with atomic_write(target) as part:
        assert part.parent == target.parent and part.suffix == ".ply"
        part.write_text("one")
        assert not target.exists()
    assert target.read_text() == "one"
    assert names_in(target.parent) == ["points.ply"]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "config.json"
    target.write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_write(target) as part:
        part.write_text("half")
        raise KeyboardInterrupt
    assert target.read_text() == "old"
    assert names_in(tmp_path) == ["config.json"]


def test_system_errors_become_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with (
        pytest.raises(WorkspaceError, match=r"cannot write .*file"),
        atomic_write(tmp_path / "file" / "x.txt"),
    ):
        pass
    with pytest.raises(WorkspaceError, match="No space left"), atomic_write(tmp_path / "x.txt"):
        raise OSError(28, "No space left on device")
    with pytest.raises(WorkspaceError, match="file with this name"), atomic_folder(tmp_path / "file"):
        pass
    with pytest.raises(ConfigError, match="as it was"), atomic_write(tmp_path / "x.txt"):
        raise ConfigError("as it was")


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
def test_a_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to(tmp_path / "real.txt")
    with atomic_write(tmp_path / "link.txt") as part:
        part.write_text("new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_text() == "new"


def test_a_new_folder_appears_in_one_step(tmp_path: Path) -> None:
    target = tmp_path / "sparse" / "0"
    with atomic_folder(target) as part:
        (part / "a.bin").write_text("a")
        (part / "sub").mkdir()
        (part / "sub" / "b.bin").write_text("b")
        assert not target.exists()
    assert names_in(tmp_path) == [
        "sparse",
        "sparse/0",
        "sparse/0/a.bin",
        "sparse/0/sub",
        "sparse/0/sub/b.bin",
    ]


def test_a_folder_that_exists_keeps_what_is_not_ours(tmp_path: Path) -> None:
    for name in ("a.bin", "a.txt", "holiday.jpg"):
        (tmp_path / name).write_text("old")
    with atomic_folder(tmp_path, stale=["a.bin", "a.txt"]) as part:
        (part / "a.bin").write_text("new")
    assert names_in(tmp_path) == ["a.bin", "holiday.jpg"]
    assert (tmp_path / "a.bin").read_text() == "new"


def test_a_failure_leaves_the_folder_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_text("old")
    for target in (tmp_path, tmp_path / "new"):
        with pytest.raises(ValueError), atomic_folder(target, stale=["a.bin"]) as part:
            (part / "a.bin").write_text("half")
            raise ValueError
    assert names_in(tmp_path) == ["a.bin"]
    assert (tmp_path / "a.bin").read_text() == "old"


@pytest.mark.skipif(os.name == "nt", reason="no such files on Windows")
def test_devices_and_pipes_are_written_to(tmp_path: Path) -> None:
    with atomic_write("/dev/null") as part:
        part.write_text("gone")
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    with pytest.raises(WorkspaceError, match="cannot write"), atomic_write(pipe) as part:
        part.write_text("nobody reads")  # an error, where it could wait for ever
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    with atomic_write(pipe) as part:
        assert part.suffix == ".json"
        part.write_text("read")
    assert os.read(reader, 10) == b"read"
    os.close(reader)
    assert names_in(tmp_path) == ["pipe.json"] and stat.S_ISFIFO(pipe.stat().st_mode)


@pytest.mark.skipif(os.name == "nt", reason="no such files on Windows")
def test_what_is_no_file_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "folder.txt").mkdir()
    with pytest.raises(WorkspaceError, match="is a folder"), atomic_write(tmp_path / "folder.txt"):
        pytest.fail("a folder")
    for kind in (os.mkfifo, os.mkdir):
        kind(tmp_path / "b.bin")
        with pytest.raises(WorkspaceError, match=r"cannot write .*b\.bin"), atomic_folder(tmp_path) as part:
            (part / "a.bin").write_text("new")
            (part / "b.bin").write_text("new")
        assert not (tmp_path / "a.bin").exists() and not (tmp_path / "b.bin").is_file()
        (os.rmdir if kind is os.mkdir else os.unlink)(tmp_path / "b.bin")
    (tmp_path / "old.bin").mkdir()
    with atomic_folder(tmp_path, stale=["old.bin"]) as part:
        (part / "a.bin").write_text("new")
    assert (tmp_path / "old.bin").is_dir()


def test_the_longest_names_can_be_written(tmp_path: Path) -> None:
    for name in ("x" * 251 + ".jpg", "\u00e4" * 125 + ".png", "a." + "y" * 250):
        with atomic_write(tmp_path / name) as part:
            part.write_text("1")
    assert len(names_in(tmp_path)) == 3


def test_parts_of_a_process_that_is_gone_are_removed(tmp_path: Path) -> None:
    """Those of running processes, of other machines, and the user's files stay."""
    own = part_beside(tmp_path / "a.txt")
    gone = tmp_path / own.name.replace(f"-{os.getpid()}-", "-4194304999-")
    elsewhere = tmp_path / gone.name.replace(gone.name[9:17], "00000000")
    earlier = tmp_path / re.sub("-[0-9a-f]{16}", "-0123456789abcdef", own.name)  # this number, another life
    mine = tmp_path / ".epipole-notes.part.txt"
    for path in (own, gone, elsewhere, earlier, mine):
        path.write_text("half")
    (tmp_path / "sub").mkdir()
    folder = tmp_path / "sub" / gone.name
    folder.mkdir()
    (folder / "x").write_text("half")
    remove_abandoned_parts(tmp_path / "sub")
    assert names_in(tmp_path / "sub") == [] and gone.exists()
    remove_abandoned_parts_below(tmp_path)
    assert names_in(tmp_path) == sorted([own.name, elsewhere.name, mine.name, "sub"])
