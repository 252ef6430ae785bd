"""Units are done once, redone when stale, and never leave half a file."""

import gc
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from epipole._checks.tables import Expected
from epipole.errors import WorkspaceError
from epipole.runs import Unit, digest, load, run_units, store, stored_key

pytestmark = pytest.mark.usefixtures("two_threads")

CALLS: list[int] = []
SQUARE = {"value": Expected("int64")}


def square(payload: int) -> dict[str, np.ndarray]:
    CALLS.append(payload)
    if payload < 0:
        raise ValueError("negative")
    return {"value": np.array(payload**2)}


def units(folder: Path, version: int = 1, numbers: tuple[int, ...] = (1, 2, 3, 4)) -> list[Unit]:
    return [Unit(folder / f"{n}.npz", digest(version, n), square, n) for n in numbers]


@pytest.mark.parametrize("executor", ["inline", "threads"])
def test_work_is_done_once_and_again_when_the_key_changes(tmp_path, executor):
    CALLS.clear()
    reports = []
    assert run_units(units(tmp_path), stage="s", executor=executor, progress=reports.append) == 4
    assert [int(load(u.path, SQUARE)["value"]) for u in units(tmp_path)] == [1, 4, 9, 16]
    assert reports[0].done == 0 and reports[-1].done == reports[-1].total == 4
    assert run_units(units(tmp_path), stage="s", executor=executor) == 0
    assert run_units(units(tmp_path, version=2), stage="s", executor=executor) == 4
    assert sorted(CALLS) == [1, 1, 2, 2, 3, 3, 4, 4]


def test_a_file_damaged_behind_its_key_is_an_error(tmp_path):
    unit = Unit(tmp_path / "1.npz", digest(1), square, 1)
    run_units([unit], stage="s")
    data = bytearray(unit.path.read_bytes())
    data[data.index(b"value.npy") + 140] ^= 255
    unit.path.write_bytes(data)
    assert stored_key(unit.path) == unit.key
    with pytest.raises(WorkspaceError, match=r"1\.npz is damaged"):
        load(unit.path, SQUARE)
    with pytest.raises(WorkspaceError, match="is damaged"):
        load(tmp_path / "none.npz", SQUARE)


def test_a_file_damaged_behind_its_key_is_done_again(tmp_path):
    (unit,) = units(tmp_path, numbers=(3,))
    run_units([unit], stage="s")
    whole = unit.path.read_bytes()
    for at in range(len(whole)):
        unit.path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        assert run_units([unit], stage="s") == 1
    assert unit.path.read_bytes() == whole and run_units([unit], stage="s") == 0


def test_what_is_no_file_of_ours_is_not_opened(tmp_path):
    unit = units(tmp_path, numbers=(3,))[0]
    np.savez_compressed(unit.path, key=np.array(unit.key), value=np.zeros(10**7))  # unpacks to any size
    assert run_units([unit], stage="s") == 1 and int(load(unit.path, SQUARE)["value"]) == 9
    unit.path.unlink()
    os.mkfifo(unit.path)
    assert stored_key(unit.path) == ""  # and does not wait for a writer


def test_processes_give_the_same_files(tmp_path):
    squares = [Unit(tmp_path / f"{n}.npz", digest(n), np_square, n) for n in (5, 6)]
    assert run_units(squares, stage="s", executor="processes") == 2
    assert [int(load(u.path, SQUARE)["value"]) for u in squares] == [25, 36]


def np_square(payload: int) -> dict[str, np.ndarray]:
    return {"value": np.array(np.square(payload))}


def test_a_damaged_file_is_done_again(tmp_path):
    run_units(units(tmp_path), stage="s")
    whole = (tmp_path / "2.npz").read_bytes()
    (tmp_path / "2.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "3.npz").write_bytes(b"")
    assert run_units(units(tmp_path), stage="s") == 2
    assert int(load(tmp_path / "2.npz", SQUARE)["value"]) == 4


def test_an_error_keeps_what_was_done_and_leaves_no_scraps(tmp_path):
    with pytest.raises(ValueError, match="negative"):
        run_units(units(tmp_path, numbers=(1, 2, -1)), stage="s", executor="inline")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["1.npz", "2.npz"]


def test_a_place_that_cannot_be_written_says_so(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(WorkspaceError, match="cannot write"):
        store(tmp_path / "file" / "x.npz", "key", {})
    assert stored_key(tmp_path / "nothing.npz") == ""


def test_many_threads_read_at_once(tmp_path):
    """Also where something in Python runs while the collector looks for cycles, in the midst of a header."""
    store(tmp_path / "unit.npz", "key", {"pixels": np.ones((5, 2)), "angles": np.ones(5)})
    table = {"pixels": Expected("float64", "n 2"), "angles": Expected("float64", "n")}
    before = gc.get_threshold(), sys.getswitchinterval()

    def busy(*_: object) -> None:
        sum(range(20))

    gc.collect()
    gc.freeze()  # what the tests before have left is not searched each time
    gc.callbacks.append(busy)
    gc.set_threshold(10)
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(8) as pool:
            read = list(pool.map(lambda _: load(tmp_path / "unit.npz", table), range(400)))
    finally:
        gc.set_threshold(*before[0])
        sys.setswitchinterval(before[1])
        gc.callbacks.remove(busy)
        gc.unfreeze()
    assert all(arrays["pixels"].shape == (5, 2) for arrays in read)


def test_digests_tell_arrays_apart():
    a = np.arange(6)
    assert digest(a) == digest(a.copy())
    assert digest(a) != digest(a.reshape(2, 3)) != digest(a.astype(float))
    assert digest("ab", "c") != digest("a", "bc")


def test_progress_counts_what_units_hold(tmp_path):
    reports = []
    units = [Unit(tmp_path / f"{n}.npz", f"key {n}", square, n, size) for n, size in enumerate((4, 4, 2))]
    run_units(units[:1], stage="pairs", progress=reports.append)
    run_units(units, stage="pairs", progress=reports.append)
    assert [(r.done, r.total) for r in reports[:2]] == [(0, 4), (4, 4)]
    assert (reports[2].done, reports[2].total) == (4, 10) and (reports[-1].done, reports[-1].total) == (
        10,
        10,
    )
