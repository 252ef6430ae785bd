"""Errors of libraries that read files become one short line."""

from pathlib import Path

import pytest

from epipole.errors import FileFormatError
from epipole.io.files import MAX_ERROR_LENGTH, read_by_others


def test_a_library_may_quote_the_whole_file():
    path = Path("recording.db3")
    with pytest.raises(FileFormatError) as error, read_by_others(path, "cannot be read"):
        raise ValueError("x" * 10_000)
    assert len(str(error.value)) < MAX_ERROR_LENGTH + 60 and "cannot be read: xxx" in str(error.value)


def test_an_error_without_words_is_named():
    with (
        pytest.raises(FileFormatError, match="cannot be read: ZeroDivisionError"),
        read_by_others(Path("a"), "cannot be read"),
    ):
        raise ZeroDivisionError
