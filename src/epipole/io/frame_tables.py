"""The table of frames that SLAM writes: `frames.csv`, a line for each frame of the source."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from epipole._declared import check_fields
from epipole.errors import FileFormatError
from epipole.io.files import file_text

FRAME_TABLE = "frames.csv"
"""Its name in an output folder."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameTable:
    """Pictures and times, in the order of the source."""

    picture: tuple[str, ...]
    timestamp_s: Float64[np.ndarray, " n"]
    """NaN for a frame that was left out."""

    def __post_init__(self) -> None:
        """Check the columns."""
        check_fields(self)


def read_frame_table(path: str | Path) -> FrameTable:
    """Read the pictures and times of all frames.

    Raises:
        FileFormatError: no such file, a column is missing, or frames are not numbered from 0.
    """
    path = Path(path)
    try:
        rows = list(csv.DictReader(io.StringIO(file_text(path))))
    except csv.Error as error:
        raise FileFormatError(path, f"is no table: {error}") from error
    pictures, times = [], []
    for number, row in enumerate(rows):
        name, time = row.get("picture"), row.get("timestamp_s")
        if row.get("frame") != str(number) or name is None or time is None:
            raise FileFormatError(path, f"frame {number}: its number, timestamp_s and picture expected")
        try:
            times.append(float(time) if time else np.nan)
        except ValueError as error:
            raise FileFormatError(path, f"frame {number}: {error}") from error
        pictures.append(name)
    return FrameTable(tuple(pictures), np.array(times, np.float64).reshape(-1))
