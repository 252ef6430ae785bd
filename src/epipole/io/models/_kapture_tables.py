"""Kapture's text tables: comma-separated values, after a line with the version of the format."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3
from epipole.io.files import file_text
from epipole.io.names import is_inside_name

VERSION_LINE = "# kapture format: 1.1"
SEPARATOR = ", "
_VERSION = re.compile(r"#\s*kapture\s+format\s*:\s*(\S+)", re.IGNORECASE)
_KNOWN_VERSION = "1.1"
_INTEGER = re.compile(r"\d{1,18}")
_FARTHEST = 1e12


class TableRow:
    """The values of a line."""

    def __init__(self, path: Path, number: int, values: list[str]) -> None:
        self.path, self.number, self.values = path, number, values

    def fail(self, problem: str) -> FileFormatError:
        """The error to raise for a problem in the line."""
        return FileFormatError(self.path, f"line {self.number}: {problem}")

    def require(self, least: int, what: str) -> None:
        """Check the number of values.

        Raises:
            FileFormatError: there are fewer.
        """
        if len(self.values) < least:
            raise self.fail(f"expected {what}, got {len(self.values)} values")

    def integer(self, index: int, what: str) -> int:
        """A whole number.

        Raises:
            FileFormatError: the value is not one.
        """
        if not _INTEGER.fullmatch(self.values[index]):
            raise self.fail(f"{what} is not a whole number, got {self.values[index][:40]!r}")
        return int(self.values[index])

    def numbers(self, start: int, stop: int | None = None) -> np.ndarray:
        """Finite numbers.

        Raises:
            FileFormatError: a value is not one.
        """
        try:
            values = np.array(self.values[start:stop], np.float64)
        except ValueError as error:
            raise self.fail(f"not numbers: {SEPARATOR.join(self.values[start:stop])[:80]!r}") from error
        if not (np.abs(values) < _FARTHEST).all():
            raise self.fail("a number is not finite, or too large")
        return values

    def motion(self, start: int) -> Rigid3 | None:
        """Quaternion (w first) and translation; None if one of them is left empty.

        Raises:
            FileFormatError: the values are not a motion.
        """
        words = self.values[start:]
        if len(words) != 7:
            raise self.fail(f"a pose needs 7 values (qw, qx, qy, qz, tx, ty, tz), got {len(words)}")
        if "" in words:
            return None
        values = self.numbers(start)
        if not 0.5 < np.linalg.norm(values[:4]) < 2.0:
            raise self.fail("the quaternion does not have length 1")
        return Rigid3.from_quat_wxyz(values[:4], values[4:])


def rows_of(path: Path) -> list[TableRow]:
    """The rows of a file, without comments and empty lines.

    Raises:
        FileFormatError: the file is missing, or of another version of the format.
    """
    rows = []
    for number, line in enumerate(file_text(path).split("\n"), 1):
        if number == 1 and (found := _VERSION.match(line)) and found[1] != _KNOWN_VERSION:
            raise FileFormatError(
                path,
                f"version {found[1][:20]} of the format is not supported, only {_KNOWN_VERSION}; upgrade it with kapture's tools",
            )
        if line.strip() and not line.startswith("#"):
            rows.append(TableRow(path, number, [word.strip() for word in line.split(",")]))
    return rows


def table_text(columns: str, rows: Iterable[Sequence[object]]) -> str:
    """The text of a table.

    Args:
        columns: names of the columns, for the comment above them.
        rows: values of each row.
    """
    lines = (SEPARATOR.join(map(str, row)) for row in rows)
    return "".join(f"{line}\n" for line in (VERSION_LINE, f"# {columns}", *lines))


def require_writable(names: Iterable[str]) -> None:
    """Check image names, which cannot be quoted.

    Raises:
        ConfigError: a name has a comma or a line break, starts or ends with a space, or leads out of the folder.
    """
    for name in names:
        if any(mark in name for mark in ",\r\n\0") or name != name.strip() or not is_inside_name(name):
            raise ConfigError(f"the image name {name!a} cannot be written to a table of kapture")
