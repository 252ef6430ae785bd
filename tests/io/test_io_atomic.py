"""Files and folders appear whole or not at all."""

import os
from pathlib import Path

import pytest

from epipole.errors import ConfigError, WorkspaceError
from epipole.io import atomic_folder, atomic_write


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
    with pytest.raises(WorkspaceError, match="file of this name"), atomic_folder(tmp_path / "file"):
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
