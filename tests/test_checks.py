"""Checks at the public border."""

from pathlib import Path

import numpy as np
import pytest

from epipole._checks import as_float_array, as_path, as_points, require_same_length
from epipole.errors import ConfigError, EpipoleError, ShapeError


def test_arrays_come_back_as_c_contiguous_doubles() -> None:
    for given in (
        [[1, 2], [3, 4]],
        np.asfortranarray(np.ones((3, 2), np.float32)),
        np.ones((4, 8), bool)[::2, ::4],
    ):
        out = as_points(given, "pixels", 2)
        assert out.dtype == np.float64 and out.flags.c_contiguous
        np.testing.assert_array_equal(out, np.asarray(given))


def test_what_fits_already_is_not_copied() -> None:
    given = np.ones((3, 2))
    assert as_float_array(given, "points") is given
    assert as_points(given, "points", 2) is given


def test_batch_axes_are_free() -> None:
    for shape in ((3, 3), (0, 3, 3), (2, 1, 5, 3, 3)):
        assert as_float_array(np.zeros(shape), "matrix", 3, 3).shape == shape


@pytest.mark.parametrize("shape", [(3,), (3, 4), (4, 3), (3, 3, 1), ()])
def test_wrong_trailing_axes(shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError, match=r"matrix must have shape \(\.\.\., 3, 3\), got"):
        as_float_array(np.zeros(shape), "matrix", 3, 3)


@pytest.mark.parametrize("shape", [(2,), (3, 3), (2, 4, 2), (0,), ()])
def test_points_are_rows(shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError, match=r"pixels must be \(n, 2\), got"):
        as_points(np.zeros(shape), "pixels", 2)


def test_columns_instead_of_rows_are_guessed() -> None:
    with pytest.raises(ShapeError, match=r"got \(3, 7\); transpose\?"):
        as_points(np.zeros((3, 7)), "rays", 3)
    with pytest.raises(ShapeError, match=r"got \(3, 7\); transpose\?"):
        as_float_array(np.zeros((3, 7)), "rays", 3)
    with pytest.raises(ShapeError, match=r"got \(4, 7\)$"):
        as_points(np.zeros((4, 7)), "rays", 3)


@pytest.mark.parametrize(
    "given", ["word", ["1", "2"], [[1.0], [1.0, 2.0]], [object()] * 2, {"a": 1}, None, [None, 1.0]]
)
def test_what_is_no_number_is_refused(given: object) -> None:
    with pytest.raises(ShapeError, match=r"^points must"):
        as_float_array(given, "points", 2)


def test_complex_numbers_do_not_lose_half_of_themselves() -> None:
    for given in ([1.0 + 2.0j, 0.0], np.array([1.0 + 2.0j, 0.0])):
        with pytest.raises(ShapeError, match="points must be an array of numbers, got complex128"):
            as_float_array(given, "points", 2)


def test_finiteness_is_asked_for() -> None:
    given = np.array([[np.nan, 1.0], [np.inf, 2.0]])
    np.testing.assert_array_equal(as_points(given, "points", 2), given)
    with pytest.raises(ShapeError, match="points must be finite; 2 values are not"):
        as_points(given, "points", 2, finite=True)
    assert as_points(np.zeros((0, 2)), "points", 2, finite=True).shape == (0, 2)


def test_lengths() -> None:
    assert require_same_length(a=np.zeros((4, 2)), b=np.zeros(4)) == 4
    assert require_same_length(a=np.zeros((0, 2))) == 0
    with pytest.raises(ShapeError, match="lengths differ: a has 4, b has 3, c has 4"):
        require_same_length(a=np.zeros(4), b=np.zeros(3), c=np.zeros(4))


def test_errors_can_be_caught_by_their_builtin_kind() -> None:
    with pytest.raises(ValueError):
        as_points([1.0], "points", 2)
    with pytest.raises(EpipoleError):
        as_points([1.0], "points", 2)


def test_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert as_path("~/photos") == tmp_path / "photos" and as_path("a~b") == Path("a~b")
    assert as_path("~no such user/x") == Path("~no such user/x")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for wrong, words in (
        ("", "a path is empty"),
        (tmp_path / "loop", "symbolic links"),
        ("x" * 5000, "too long"),
        ("a\0b", "null character"),
    ):
        with pytest.raises(ConfigError, match=words):
            as_path(wrong)
