"""What annotations declare: arguments and fields are refused, or converted without loss."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64, UInt8

from epipole._checks import Declared, checked
from epipole._checks.arrays import as_array
from epipole._checks.values import converter_of
from epipole.errors import ConfigError, EpipoleError, ShapeError


class Side(IntEnum):
    LEFT = 1
    RIGHT = 2


def convert(annotation: Any, value: Any) -> Any:
    one = converter_of(annotation)
    assert one is not None
    return one(value, "it", {})


@pytest.mark.parametrize(
    ("annotation", "value", "expected"),
    [
        *[(int, np.int32(3), 3), (float, 3, 3.0), (float, np.float32(0.5), 0.5), (bool, np.True_, True)],
        *[(float, float("inf"), float("inf")), (int | None, None, None), (Side, 2, Side.RIGHT)],
        *[(Literal["a", "b"], "b", "b"), (Literal[4, 8], np.int64(8), 8), (tuple[int, int], [1, 2], (1, 2))],
        *[(Path | None, "a/b", Path("a/b")), (tuple[float, ...], (1, 2.5), (1.0, 2.5)), (str, "x", "x")],
        *[(Sequence[int], (1, np.int8(2)), [1, 2]), (Side, Side.LEFT, Side.LEFT)],
    ],
)
def test_what_means_the_same_is_converted(annotation, value, expected):
    found = convert(annotation, value)
    assert found == expected and type(found) is type(expected)


@pytest.mark.parametrize(
    ("annotation", "value"),
    [
        *[(int, 1.0), (int, True), (int, "1"), (int, None), (int, 10**30), (int, np.array([1])), (int, 1j)],
        *[(float, float("nan")), (float, "1"), (float, True), (float, 1j), (float, 10**400), (float, [1.0])],
        *[
            (bool, 1),
            (bool, None),
            (Side, 3),
            (Side, True),
            (Side, "LEFT"),
            (Literal["a"], "c"),
            (Literal[4], 4.0),
        ],
        *[(tuple[int, int], (1,)), (tuple[int, int], 3), (tuple[int, int], "ab"), (Sequence[int], [1, None])],
        *[(str, 3), (Path, 3), (Callable[[int], int], 3), (Side | None, "x"), (Sequence[int], {1: 2})],
        *[(dict, 3), (float | None, np.zeros(2)), (None, 3)],
    ],
)
def test_what_means_something_else_is_refused(annotation, value):
    with pytest.raises(ConfigError, match=r"^it"):
        convert(annotation, value)


@pytest.mark.parametrize(
    ("annotation", "value"),
    [
        *[(Float64[np.ndarray, "n 3"], np.zeros((2, 4))), (Float64[np.ndarray, "n 3"], np.zeros(3))],
        *[(Int64[np.ndarray, " n"], np.array([0.0, 1.0])), (Int64[np.ndarray, " n"], np.array([True]))],
        *[(Int32[np.ndarray, " n"], np.array([2**31])), (UInt8[np.ndarray, " n"], np.array([-1]))],
        *[(Float64[np.ndarray, " n"], np.array(["1"])), (Float64[np.ndarray, " n"], np.array([1j]))],
        *[(Bool[np.ndarray, " n"], np.array([1, 0])), (Float64[np.ndarray, " n"], [[1], [2, 3]])],
        *[(Float64[np.ndarray, " n"], None), (Float64[np.ndarray, "n n"], np.zeros((2, 3)))],
        *[
            (Float64[np.ndarray, "*batch 3"], np.zeros((2, 2))),
            (Float64[np.ndarray, "*batch 3"], np.array(1.0)),
        ],
    ],
)
def test_arrays_of_other_shapes_and_kinds_are_refused(annotation, value):
    with pytest.raises(ShapeError, match=r"^it must be"):
        convert(annotation, value)


@pytest.mark.parametrize(
    ("annotation", "dtype"),
    [
        *[(Float64[np.ndarray, "n 2"], np.float64), (Float32[np.ndarray, "n 2"], np.float32)],
        *[(Int32[np.ndarray, "n 2"], np.int32), (Int64[np.ndarray, "n 2"], np.int64)],
        *[(UInt8[np.ndarray, "n 2"], np.uint8), (Float[np.ndarray, "*any"], np.float64)],
    ],
)
def test_arrays_become_what_kernels_take(annotation, dtype):
    values = np.arange(6).reshape(3, 2)
    read_only = values.astype(dtype)
    read_only.flags.writeable = False
    for given in (
        *(values, values.tolist(), values.astype(np.uint8), read_only, np.asfortranarray(values), values[:0]),
        *(values.astype(">i4"), np.repeat(values, 2, axis=0)[::2]),
    ):
        found = convert(annotation, given)
        assert found.dtype == dtype and found.dtype.isnative and found.flags.carray
        np.testing.assert_array_equal(found, given)


def test_what_fits_is_not_copied():
    for array in (np.zeros((3, 2)), np.zeros(()), np.zeros((0, 2))):
        assert as_array(array, "it", np.dtype(np.float64)) is array


def test_axes_of_one_name_have_one_length():
    @checked
    def paired(
        first: Float64[np.ndarray, "n 3"], second: Float64[np.ndarray, "n 2"], scale: float = 1.0
    ) -> float:
        return float(first.sum() + second.sum()) * scale

    assert paired(np.ones((2, 3)), second=[[1, 1], [1, 1]], scale=2) == 20.0
    with pytest.raises(ShapeError, match=r"second must be \(n, 2\) with n = 2 \(as in first\), got \(3, 2\)"):
        paired(np.ones((2, 3)), np.ones((3, 2)))
    with pytest.raises(TypeError, match="scales"):
        paired(np.ones((2, 3)), np.ones((2, 2)), scales=1.0)


@dataclass(frozen=True, slots=True)
class _Columns(Declared):
    index: Int64[np.ndarray, " n"]
    size: int | None = None


def test_fields_are_checked_and_converted():
    made = _Columns(np.array([1, 2], np.int32), np.int16(3))
    assert made.index.dtype == np.int64 and type(made.size) is int
    assert len(_Columns([]).index) == 0  # of no numbers the kind is not asked
    with pytest.raises(ShapeError, match="index must be an array of whole numbers, got float64"):
        _Columns(np.array([1.0]))


def test_every_refusal_is_ours():
    assert issubclass(ShapeError, EpipoleError) and issubclass(ConfigError, EpipoleError)


def test_items_of_an_iterator_are_checked_when_they_are_taken():
    """Large items that are given one after the other need not be in memory together."""
    taken = []

    @checked
    def first_of(rows: Iterable[Float64[np.ndarray, " n"]]) -> Any:
        taken.append("called")
        return [float(row[0]) for row in rows]

    def given(second: Any):
        taken.append("first")
        yield np.ones(3)
        taken.append("second")
        yield second

    assert first_of(given(np.zeros(3))) == [1.0, 0.0]
    assert taken == ["called", "first", "second"]
    with pytest.raises(ShapeError, match=r"rows\[1\]"):
        first_of(given(np.zeros((2, 2))))
