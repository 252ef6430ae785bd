"""What a run leaves behind, damaged: units are redone, marks are refused, summaries are taken for missing."""

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from epipole._checks.tables import Expected
from epipole.errors import FileFormatError, WorkspaceError
from epipole.pipelines.stereo.files import read_stereo
from epipole.pipelines.stereo.pairs import read_summary
from epipole.runs import claim, store, stored_key
from epipole.runs.folder import MARK, read_mark
from epipole.runs.units import load
from hostile_bytes import NUMBERS, read_or_refuse, spoil_one


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("left")


@pytest.fixture(scope="module")
def mark(folder: Path) -> bytes:
    claimed = claim(folder / "claimed", "reconstruct", [Path("/some/pictures")])
    claimed.write_json("summary.json", {"num_images": 3})
    claimed.timings_s = {"read": 0.25}
    claimed.save()
    return (folder / "claimed" / MARK).read_bytes()


def test_a_sound_mark_is_read(folder: Path, mark: bytes) -> None:
    found = read_mark(folder / "claimed")
    assert (found.kind, str(found.source), found.files) == (
        "reconstruct",
        "/some/pictures",
        {"summary.json": ["summary.json"]},
    )
    with pytest.raises(WorkspaceError, match="damaged"):
        spoil_one(folder / "cut", {MARK: mark}, MARK, mark[:-20])
        read_mark(folder / "cut")


UNIT = {"keypoints": np.arange(12.0).reshape(6, 2), "descriptors": np.zeros((6, 128), np.uint8)}


def test_a_unit_whose_key_claims_to_be_of_any_size_takes_no_memory(folder: Path) -> None:
    """The header of its key says 2^36 letters."""
    path = folder / "claims.npz"
    store(path, "x" * 20, {})
    assert stored_key(path) == "x" * 20
    data = path.read_bytes()
    assert b"'<U20'" in data
    path.write_bytes(data.replace(b"'shape': (), }         ", b"'shape': (68719476736,),"))
    assert read_or_refuse(stored_key, path) == ""


def test_deep_and_endless_summaries(folder: Path) -> None:
    for text in ("[" * 100_000, '{"a": ' * 100_000, *NUMBERS):
        (folder / "summary.json").write_text(text, encoding="utf-8")
        assert read_or_refuse(read_summary, folder) == {}
    with pytest.raises(FileFormatError, match="no depth"):
        read_stereo(folder)


UNIT_TABLE = {"keypoints": Expected("float64", "n 2"), "descriptors": Expected("uint8", "n 128")}
ZEROS = {"zeros": Expected("uint8", "n")}


def repacked(data: bytes, change: Callable[[bytes], bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    """The same archive with other members, whose sums are right."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as source, zipfile.ZipFile(out, "w", compression) as target:
        for name in source.namelist():
            target.writestr(name, change(source.read(name)))
    return out.getvalue()


HEADERS = {
    "an open bracket": lambda member: member.replace(b"'shape': (", b"'shape': [", 1),
    "half a text": lambda member: member.replace(b"'descr'", b"'" * 3 + b"esc", 1),
    "another version": lambda member: member.replace(b"NUMPY\x01", b"NUMPY\x09", 1),
}


@pytest.mark.parametrize("what", list(HEADERS))
def test_a_unit_whose_arrays_have_broken_headers(folder: Path, what: str) -> None:
    """NumPy's own reader stumbles over them, with errors of Python's parser."""
    path = folder / "header.npz"
    store(path, "key", UNIT)
    path.write_bytes(repacked(path.read_bytes(), HEADERS[what]))
    assert stored_key(path) == ""
    with pytest.raises(WorkspaceError, match=r"header\.npz is damaged"):
        load(path, UNIT_TABLE)


def test_a_unit_that_is_packed_or_asks_for_another_zip(folder: Path) -> None:
    path = folder / "packed.npz"
    store(path, "key", {"zeros": np.zeros(1 << 20, np.uint8)})
    valid = path.read_bytes()
    assert stored_key(path) == "key"
    path.write_bytes(repacked(valid, bytes, zipfile.ZIP_DEFLATED))
    with pytest.raises(WorkspaceError, match="more than the"):
        load(path, ZEROS)
    at = valid.rindex(b"PK\x01\x02")
    path.write_bytes(valid[: at + 6] + b"\xc6\0" + valid[at + 8 :])
    with pytest.raises(WorkspaceError, match="damaged"):
        load(path, ZEROS)
    np.save(folder / "one.npy", np.zeros(3))
    with pytest.raises(WorkspaceError, match="damaged"):
        load(folder / "one.npy", ZEROS)


def test_a_mark_or_a_summary_that_is_nested_without_end(folder: Path) -> None:
    deep = folder / "deep"
    spoil_one(deep, {MARK: b""}, MARK, b'{"format": ' + b"[" * 100_000)
    with pytest.raises(WorkspaceError, match="damaged"):
        read_mark(deep)
    (deep / "summary.json").write_text("[" * 100_000)
    assert read_summary(deep) == {}
