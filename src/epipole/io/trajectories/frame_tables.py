"""The table of frames that SLAM writes: `frames.csv`, one line per frame of the source."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from epipole._checks import check_fields, checked
from epipole.errors import FileFormatError
from epipole.io.files import file_text

FRAME_TABLE = "frames.csv"
"""Name of the table in an output folder."""
_DIGITS = 7
"""Most digits of a frame number: four days at 30 Hz."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameTable:
    """Image names and times, in the order of the source."""

    image: tuple[str, ...]
    """Empty for a frame that was dropped to keep up."""
    timestamp_s: Float64[np.ndarray, " n"]
    """NaN for a frame that was dropped or skipped."""

    def __post_init__(self) -> None:
        """Check the columns."""
        check_fields(self)


@checked
def read_frame_table(path: str | Path) -> FrameTable:
    """Read the image names and times of all frames.

    Raises:
        FileFormatError: the file is missing, a column is missing, or frame numbers do not increase.
    """
    path = Path(path)
    try:
        rows = list(csv.DictReader(io.StringIO(file_text(path))))
    except csv.Error as error:
        raise FileFormatError(path, f"not a table: {error}") from error
    images: list[str] = []
    times: list[float] = []
    for row in rows:
        name, time, given = row.get("image"), row.get("timestamp_s"), row.get("frame") or ""
        number = int(given) if given.isascii() and given.isdecimal() and len(given) <= _DIGITS else -1
        if number < len(images) or name is None or time is None:
            position = f"frame {len(images)}"
            raise FileFormatError(path, f"{position}: expected columns frame, timestamp_s and image")
        try:
            seconds = float(time) if time else np.nan
        except ValueError as error:
            raise FileFormatError(path, f"frame {number}: {error}") from error
        num_dropped = number - len(images)
        images += [*num_dropped * [""], name]
        times += [*num_dropped * [np.nan], seconds]
    return FrameTable(tuple(images), np.array(times, np.float64).reshape(-1))
