"""Files that say what is known besides the images: lengths, measured places of images, distances travelled."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from epipole._declared import checked
from epipole.errors import FileFormatError
from epipole.io.files import file_text
from epipole.io.trajectories.files import PositionLog, read_positions, read_trajectory

_POSITION, _LENGTH, _DISTANCE = 3, 6, 2
_LARGEST = 1e12


@dataclass(frozen=True, slots=True, eq=False)
class KnownLength:
    """A length, and where its two ends are seen."""

    name: str
    length_m: float
    ends: tuple[dict[str, tuple[float, float]], dict[str, tuple[float, float]]]
    """Of each end: names of images, and the pixel there."""


@dataclass(frozen=True, slots=True, eq=False)
class NamedPositions:
    """Measured places of images."""

    names: tuple[str, ...]
    positions: Float64[np.ndarray, "n 3"]


@dataclass(frozen=True, slots=True, eq=False)
class OdometryLog:
    """How far something went by its wheels."""

    timestamp_s: Float64[np.ndarray, " n"]
    """Rising."""
    travelled_m: Float64[np.ndarray, " n"] | None
    """Distance since the begin, along the way; None where places are known."""
    positions: Float64[np.ndarray, "n 3"] | None
    """Places by odometry."""


@checked
def read_lengths(path: str | Path) -> tuple[KnownLength, ...]:
    """Read known lengths: a line for each end in each image, `NAME METRES END PICTURE X Y`.

    END is a or b. Names of images may have blanks. Lines that start with # are skipped.

    Raises:
        FileFormatError: no such file, a line that is none, or an end that is seen in no image.
    """
    path = Path(path)
    found: dict[str, KnownLength] = {}
    for number, words in _lines(path):
        if len(words) < _LENGTH or words[2] not in ("a", "b"):
            raise FileFormatError(
                path, f"line {number}: NAME METRES END PICTURE X Y expected, and END a or b"
            )
        metres, x, y = (_number(path, number, word) for word in (words[1], *words[-2:]))
        if not metres > 0:
            raise FileFormatError(path, f"line {number}: a length must be positive, got {metres:g}")
        known = found.setdefault(words[0], KnownLength(words[0], metres, ({}, {})))
        if known.length_m != metres:
            raise FileFormatError(
                path, f"line {number}: {words[0]} is {metres:g} m long here, {known.length_m:g} above"
            )
        end, image = known.ends[int(words[2] == "b")], " ".join(words[3:-2])
        if image in end:
            raise FileFormatError(path, f"line {number}: end {words[2]} in {image} stands above already")
        end[image] = (x, y)
    for known in found.values():
        for name, end in zip("ab", known.ends):
            if not end:
                raise FileFormatError(path, f"end {name} of {known.name} is seen in no image")
    if not found:
        raise FileFormatError(path, "holds no length")
    return tuple(found.values())


@checked
def read_anchor_positions(path: str | Path) -> PositionLog | NamedPositions:
    """Read measured places: `SECONDS X Y Z` a line, or `PICTURE X Y Z` (the names may have blanks).

    Raises:
        FileFormatError: no such file, a line that is none, or an image that stands there twice.
    """
    path = Path(path)
    lines = _lines(path)
    if lines and _is_number(lines[0][1][0]):
        return read_positions(path)
    names, positions = [], []
    for number, words in lines:
        if len(words) <= _POSITION:
            raise FileFormatError(path, f"line {number}: PICTURE X Y Z expected, or SECONDS X Y Z")
        names.append(" ".join(words[:-_POSITION]))
        positions.append([_number(path, number, word) for word in words[-_POSITION:]])
    if not names:
        raise FileFormatError(path, "holds no place")
    if len(set(names)) < len(names):
        double = next(name for n, name in enumerate(names) if name in names[:n])
        raise FileFormatError(path, f"{double} stands there twice")
    return NamedPositions(tuple(names), np.array(positions))


@checked
def read_odometry(path: str | Path) -> OdometryLog:
    """Read odometry: `SECONDS METRES` a line, the distance since any begin; or a trajectory in TUM's form.

    Raises:
        FileFormatError: no such file, a line that is none, times that do not rise, or a distance that falls.
    """
    path = Path(path)
    lines = _lines(path)
    if not lines:
        raise FileFormatError(path, "holds no odometry")
    if len(lines[0][1]) != _DISTANCE:
        known = read_trajectory(path, "tum")
        rises = np.diff(known.timestamp_s, prepend=-np.inf) > 0
        kept = known.timestamp_s[rises]
        return OdometryLog(kept, None, known.world_from_body.translation[rises])
    values = np.empty((len(lines), 2))
    for n, (number, words) in enumerate(lines):
        if len(words) != _DISTANCE:
            raise FileFormatError(path, f"line {number}: SECONDS METRES expected")
        values[n] = [_number(path, number, word) for word in words]
        if n and not (values[n, 0] > values[n - 1, 0] and values[n, 1] >= values[n - 1, 1]):
            raise FileFormatError(path, f"line {number}: times must rise, and distances may not fall")
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
        raise FileFormatError(path, f"line {line}: {word!r} is no number")
    value = float(word)
    if not math.isfinite(value) or abs(value) > _LARGEST:
        raise FileFormatError(path, f"line {line}: {word} is no number to calculate with")
    return value
