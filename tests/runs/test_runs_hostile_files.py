"""What a run leaves behind, damaged: units are redone, marks are refused, summaries are taken for missing."""

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from epipole._checks.tables import Expected
from epipole.errors import FileFormatError, WorkspaceError
from epipole.io.images.depth_maps import write_pfm
from epipole.io.images.photographs import write_jpeg_with_exif
from epipole.pipelines.sfm.matching.pairing import read_pairs
from epipole.pipelines.stereo.files import read_stereo
from epipole.pipelines.stereo.pairs import read_summary
from epipole.runs import claim, store, stored_key
from epipole.runs.folder import MARK, read_mark
from epipole.runs.units import load
from hostile_bytes import NUMBERS, read_or_refuse, spoil_one, spoilt


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


@given(data=st.data())
def test_the_mark_of_a_folder(folder: Path, mark: bytes, data: st.DataObject) -> None:
    """Refused, or names and numbers of their kinds."""
    where = folder / "marked"
    spoil_one(where, {MARK: mark}, MARK, data.draw(spoilt(mark, is_text=True)))
    found = read_or_refuse(read_mark, where, names=where.name)
    if found is not None:
        assert all(isinstance(name, str) for names in found.files.values() for name in names)
        assert all(isinstance(seconds, float) for seconds in found.timings_s.values())


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


@given(data=st.data())
def test_units(folder: Path, data: st.DataObject) -> None:
    """A damaged unit has another key or none, and is done again; never an error."""
    path = folder / "unit.npz"
    store(path, "0123456789abcdef", UNIT)
    path.write_bytes(data.draw(spoilt(path.read_bytes(), is_text=False)))
    assert isinstance(read_or_refuse(stored_key, path), str)


def test_a_unit_whose_key_claims_to_be_of_any_size_takes_no_memory(folder: Path) -> None:
    """The header of its key says 2^36 letters."""
    path = folder / "claims.npz"
    store(path, "x" * 20, {})
    assert stored_key(path) == "x" * 20
    data = path.read_bytes()
    assert b"'<U20'" in data
    path.write_bytes(data.replace(b"'shape': (), }         ", b"'shape': (68719476736,),"))
    assert read_or_refuse(stored_key, path) == ""


def stereo_files() -> dict[str, bytes]:
    """A folder as `epipole stereo` leaves it, as far as it is read back."""
    K = [[500.0, 0.0, 3.5], [0.0, 500.0, 2.5], [0.0, 0.0, 1.0]]
    return {"rig.json": json.dumps({"K": K, "baseline": 0.1}, indent=1).encode()}


@pytest.mark.parametrize("name", ["rig.json", "depth.pfm", "sigma_depth.pfm", "left.png"])
@given(data=st.data())
def test_depth_read_back(folder: Path, name: str, data: st.DataObject) -> None:
    where = folder / "stereo"
    where.mkdir(exist_ok=True)
    for pfm in ("depth.pfm", "sigma_depth.pfm"):
        write_pfm(where / pfm, np.ones((6, 8)))
    write_jpeg_with_exif(where / "left.png", np.zeros((6, 8, 3), np.uint8))
    valid = stereo_files() | {p.name: p.read_bytes() for p in sorted(where.iterdir()) if p.name != "rig.json"}
    spoil_one(where, valid, name, data.draw(spoilt(valid[name], is_text=name == "rig.json")))
    found = read_or_refuse(read_stereo, where, names=where.name)
    if found is not None:
        assert found.K.shape == (3, 3) and np.isfinite(found.K).all()
        assert found.depths.shape == found.left_rgb.shape[:2]


@given(data=st.data())
def test_the_summary_of_many_pairs(folder: Path, data: st.DataObject) -> None:
    valid = json.dumps({"done": ["a"], "known": {"a": 0.9}, "warnings": {}, "problems": {}}).encode()
    (folder / "summary.json").write_bytes(data.draw(spoilt(valid, is_text=True)))
    found = read_or_refuse(read_summary, folder)
    assert isinstance(found, dict) and isinstance(found.get("known", {}), dict)


@given(data=st.data())
def test_lists_of_pairs(folder: Path, data: st.DataObject) -> None:
    path = folder / "pairs.txt"
    path.write_bytes(data.draw(spoilt(b"# pairs\na.jpg b.jpg\nb.jpg c.jpg\n\nc.jpg a.jpg\n", is_text=True)))
    found = read_or_refuse(read_pairs, path, ["a.jpg", "b.jpg", "c.jpg"], names=path.name)
    assert found is None or ((found >= 0) & (found < 3)).all()


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
