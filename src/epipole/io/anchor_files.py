"""Files with measurements other than images: known lengths, camera positions and distances traveled."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from epipole._checks import checked
from epipole.errors import FileFormatError
from epipole.io.files import file_text
from epipole.io.trajectories.files import PositionLog, read_positions, read_trajectory

_POSITION, _LENGTH, _DISTANCE = 3, 6, 2
_LARGEST = 1e12


@dataclass(frozen=True, slots=True, eq=False)
class KnownLength:
    """A known length and the image observations of its two ends."""

    name: str
    length_m: float
    ends: tuple[dict[str, tuple[float, float]], dict[str, tuple[float, float]]]
    """For each end: pixel (x, y) by image name."""


@dataclass(frozen=True, slots=True, eq=False)
class NamedPositions:
    """Measured camera positions by image name."""

    names: tuple[str, ...]
    positions: Float64[np.ndarray, "n 3"]


@dataclass(frozen=True, slots=True, eq=False)
class OdometryLog:
    """Wheel odometry: distances or positions over time."""

    timestamp_s: Float64[np.ndarray, " n"]
    """Strictly increasing."""
    traveled_m: Float64[np.ndarray, " n"] | None
    """Distance along the trajectory since the start; None if positions are known."""
    positions: Float64[np.ndarray, "n 3"] | None
    """Positions from odometry."""


@checked
def read_lengths(path: str | Path) -> tuple[KnownLength, ...]:
    """Read known lengths: one line for each end in each image, `NAME METERS END IMAGE X Y`.

    END is a or b. Image names may contain spaces. Lines that start with # are skipped.

    Raises:
        FileFormatError: the file is missing, a line is malformed, or an end is seen in no image.
    """
    path = Path(path)
    found: dict[str, KnownLength] = {}
    for number, words in _lines(path):
        if len(words) < _LENGTH or words[2] not in ("a", "b"):
            raise FileFormatError(path, f"line {number}: expected NAME METERS END IMAGE X Y with END a or b")
        meters, x, y = (_number(path, number, word) for word in (words[1], *words[-2:]))
        if not meters > 0:
            raise FileFormatError(path, f"line {number}: a length must be positive, got {meters:g}")
        known = found.setdefault(words[0], KnownLength(words[0], meters, ({}, {})))
        if known.length_m != meters:
            raise FileFormatError(
                path, f"line {number}: {words[0]} is {meters:g} m long here, {known.length_m:g} above"
            )
        end, image = known.ends[int(words[2] == "b")], " ".join(words[3:-2])
        if image in end:
            raise FileFormatError(path, f"line {number}: end {words[2]} in {image} is given twice")
        end[image] = (x, y)
    for known in found.values():
        for name, end in zip("ab", known.ends):
            if not end:
                raise FileFormatError(path, f"end {name} of {known.name} is seen in no image")
    if not found:
        raise FileFormatError(path, "it contains no lengths")
    return tuple(found.values())


@checked
def read_anchor_positions(path: str | Path) -> PositionLog | NamedPositions:
    """Read measured positions: one `SECONDS X Y Z` or `IMAGE X Y Z` per line (image names may contain spaces).

    Raises:
        FileFormatError: the file is missing, a line is malformed, or an image is listed twice.
    """
    path = Path(path)
    lines = _lines(path)
    if lines and _is_number(lines[0][1][0]):
        return read_positions(path)
    names, positions = [], []
    for number, words in lines:
        if len(words) <= _POSITION:
            raise FileFormatError(path, f"line {number}: expected IMAGE X Y Z or SECONDS X Y Z")
        names.append(" ".join(words[:-_POSITION]))
        positions.append([_number(path, number, word) for word in words[-_POSITION:]])
    if not names:
        raise FileFormatError(path, "it contains no positions")
    if len(set(names)) < len(names):
        double = next(name for n, name in enumerate(names) if name in names[:n])
        raise FileFormatError(path, f"{double} is listed twice")
    return NamedPositions(tuple(names), np.array(positions))


@checked
def read_odometry(path: str | Path) -> OdometryLog:
    """Read odometry: one `SECONDS METERS` per line, the distance since any start; or a trajectory in TUM format.

    Raises:
        FileFormatError: the file is missing, a line is malformed, times do not increase, or a distance decreases.
    """
    path = Path(path)
    lines = _lines(path)
    if not lines:
        raise FileFormatError(path, "it contains no odometry")
    if len(lines[0][1]) != _DISTANCE:
        known = read_trajectory(path, "tum")
        rises = np.diff(known.timestamp_s, prepend=-np.inf) > 0
        kept = known.timestamp_s[rises]
        return OdometryLog(kept, None, known.world_from_body.translation[rises])
    values = np.empty((len(lines), 2))
    for n, (number, words) in enumerate(lines):
        if len(words) != _DISTANCE:
            raise FileFormatError(path, f"line {number}: expected SECONDS METERS")
        values[n] = [_number(path, number, word) for word in words]
        if n and not (values[n, 0] > values[n - 1, 0] and values[n, 1] >= values[n - 1, 1]):
            raise FileFormatError(path, f"line {number}: times must increase and distances must not decrease")
    return OdometryLog(values[:, 0].copy(), values[:, 1].copy(), None)


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    out = []
    for number, line in enumerate(file_text(path).splitlines(), 1):
        words = line.replace(",", " ").split()
        if words and not words[0].startswith("#"):
            out.append((number, words))
    return out


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _number(path: Path, line: int, word: str) -> float:
    if not _is_number(word):
        raise FileFormatError(path, f"line {line}: {word!r} is not a number")
    value = float(word)
    if not math.isfinite(value) or abs(value) > _LARGEST:
        raise FileFormatError(path, f"line {line}: {word} is not finite, or exceeds 1e12")
    return value
