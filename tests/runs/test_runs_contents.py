"""Digests of files are those of their bytes, and unchanged files are not read again."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from epipole.errors import FileFormatError
from epipole.runs import content_digests, contents


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    out = [tmp_path / name for name in ("a.jpg", "b, ü.jpg", "c.jpg")]
    for path, text in zip(out, ("one", "two", "one")):
        path.write_text(text)
    return out


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    names = []
    plain = contents._digest_of
    monkeypatch.setattr(contents, "_digest_of", lambda path: (names.append(path.name), plain(path))[1])
    return names


def test_equal_files_have_equal_digests(files: list[Path], tmp_path: Path) -> None:
    found = content_digests(files, tmp_path / "memory.npz")
    assert found[files[0]] == found[files[2]] != found[files[1]]


def test_only_changed_files_are_read_again(files: list[Path], tmp_path: Path, read: list[str]) -> None:
    memory = tmp_path / "work" / "memory.npz"
    first = content_digests(files, memory)
    assert sorted(read) == sorted(path.name for path in files)
    del read[:]
    assert content_digests(files, memory) == first and read == []
    files[0].write_text("three")
    os.utime(files[2], ns=(1, 1))
    again = content_digests(files, memory)
    assert sorted(read) == ["a.jpg", "c.jpg"]
    assert again[files[0]] != first[files[0]] and again[files[2]] == first[files[2]]


def test_a_damaged_memory_is_made_again(files: list[Path], tmp_path: Path, read: list[str]) -> None:
    memory = tmp_path / "memory.npz"
    first = content_digests(files, memory)
    memory.write_bytes(memory.read_bytes()[:-3])
    assert content_digests(files, memory) == first
    assert len(read) == 2 * len(files)


def test_a_file_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(FileFormatError, match="folder"):
        content_digests([tmp_path / "folder"], tmp_path / "memory.npz")
