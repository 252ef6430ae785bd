"""Lists of frames and their times in dataset formats."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np

from epipole.errors import FileFormatError
from epipole.io._time_units import seconds_of
from epipole.io.files import file_text
from epipole.io.names import path_inside

Time = TypeVar("Time", int, float)
TIMES = "times.txt"
_LEAST_STEP_S = 1e-4
"""Shortest time between the images of a camera; less means a wrong unit."""


def timed_names(folder: Path, name: str) -> list[tuple[float, Path]]:
    """Rows of a time and a file path."""
    out = []
    for number, line in enumerate(file_text(folder / name).splitlines(), 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            time, file = float(words[0]), words[1]
        except (ValueError, IndexError) as error:
            raise FileFormatError(folder / name, f"line {number}: expected a time and a file name") from error
        if not np.isfinite(time):
            raise FileFormatError(folder / name, f"line {number}: the time is not finite")
        out.append((time, path_inside(folder, file)))
    if not out:
        raise FileFormatError(folder / name, "it lists no images")
    return out


def in_seconds(rows: list[tuple[float, Path]]) -> list[tuple[float, Path]]:
    """The same rows with times converted to seconds, if they are in another unit of a computer's clock."""
    times, _ = seconds_of(np.array([time for time, _ in rows]))
    return list(zip(times.tolist(), (path for _, path in rows)))


def timed_names_of_camera(folder: Path) -> list[tuple[int, Path]]:
    """Nanoseconds and images in EuRoC's `data.csv`."""
    out = []
    for number, line in enumerate(file_text(folder / "data.csv").splitlines(), 1):
        words = [word.strip() for word in line.split(",")]
        if not words[0] or words[0].startswith("#"):
            continue
        try:
            nanoseconds = int(words[0])
            if abs(nanoseconds) >= 2**63:
                raise ValueError("timestamp out of range")
            out.append((nanoseconds, path_inside(folder / "data", words[1])))
        except (ValueError, IndexError) as error:
            problem = f"line {number}: expected an integer number of nanoseconds and a file name"
            raise FileFormatError(folder / "data.csv", problem) from error
    if not out:
        raise FileFormatError(folder / "data.csv", "it lists no images")
    step_s = (
        float(np.median(np.diff(sorted(nanoseconds for nanoseconds, _ in out)))) * 1e-9
        if len(out) > 2
        else 1.0
    )
    if 0 < step_s < _LEAST_STEP_S:
        raise FileFormatError(
            folder / "data.csv",
            f"its images would be {step_s:.2g} s apart if its times were nanoseconds (EuRoC), so they are probably in another unit",
        )
    return out


def in_order(name: str, rows: list[tuple[Time, Path]]) -> tuple[list[tuple[Time, Path]], tuple[str, ...]]:
    """Sort rows by time and drop repeated times; also returns warnings about both."""
    late = sum(later[0] < earlier[0] for earlier, later in pairwise(rows))
    first = dict(reversed(rows))
    doubled = len(rows) - len(first)
    warnings = [f"{name}: {late} lines are earlier than the previous line, and were sorted"] if late else []
    if doubled:
        warnings.append(f"{name}: {doubled} lines repeat a time; only the first of each is used")
    return sorted(first.items()), tuple(warnings)


def by_number(names: tuple[str, ...]) -> tuple[str, ...]:
    """Sort names numerically if all are numbers, so that "10.png" comes after "9.png"."""
    stems = [Path(name).stem for name in names]
    if not all(stem.isascii() and stem.isdecimal() for stem in stems):
        return names
    return tuple(sorted(names, key=lambda name: (str(Path(name).parent), int(Path(name).stem), name)))


def times_of(folder: Path, names: tuple[str, ...], rate_hz: float) -> tuple[list[float], tuple[str, ...]]:
    """Times of images in seconds from `times.txt`, one number per line, or at a constant rate; and warnings.

    Raises:
        FileFormatError: a line is not one number, times do not increase, or their count differs from the number of
            images and the image names do not say which belong together.
    """
    path = folder / TIMES
    if not path.is_file():
        return [n / rate_hz for n in range(len(names))], ()
    values = _numbers(path)
    if not np.isfinite(values).all() or (np.diff(values) <= 0).any():
        wrong = int(np.argmin(np.isfinite(values) & (np.diff(values, prepend=-np.inf) > 0))) + 1
        raise FileFormatError(path, f"time {wrong} is not a finite number larger than the previous one")
    times, unit = seconds_of(values)
    warnings = [] if unit is None else [f"{TIMES}: its times are in {unit}"]
    if len(times) != len(names):
        rows = _rows_by_name(path, len(times), names)
        words = f"{TIMES} has {len(times)} lines for {len(names)} images: they are paired by the numbers in the image names"
        return times[rows].tolist(), (*warnings, f"{words}, where line 1 is number 0")
    return times.tolist(), tuple(warnings)


def _numbers(path: Path) -> np.ndarray:
    values = []
    for number, line in enumerate(file_text(path).splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            (value,) = (float(word) for word in words)
        except ValueError as error:
            raise FileFormatError(path, f"line {number}: expected one number per line") from error
        values.append(value)
    return np.array(values, np.float64)


def _rows_by_name(path: Path, num_times: int, names: tuple[str, ...]) -> np.ndarray:
    """Rows of the times by the numbers in the image names, which start from 0 as in KITTI."""
    stems = [Path(name).stem for name in names]
    if all(stem.isascii() and stem.isdecimal() and len(stem) < 10 for stem in stems):
        rows = np.array([int(stem) for stem in stems])
        # Names that start with 1 may count from 0 or from 1.
        if (
            len(set(stems)) == len(stems)
            and rows.max() < num_times
            and rows.min() != 1
            and (np.diff(rows) > 0).all()
        ):
            return rows
    raise FileFormatError(
        path,
        f"it has {num_times} times for {len(names)} images, and the image names do not say which belong together: write one line "
        "per image",
    )
