"""Control points and their image observations, as in OpenSfM and OpenDroneMap: gcp_list.txt and ground_control_points.json.

gcp_list.txt: the first line names the coordinate system, each other line is an observation,

    x y z pixel_x pixel_y image [name]

with x = longitude or easting, y = latitude or northing, z = height in meters (NaN if unknown). Without names, lines with
the same coordinates belong to one point. Points whose names start with CHK- are check points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from epipole._checks import Declared, checked
from epipole.errors import FileFormatError
from epipole.io.files import file_text, read_json
from epipole.io.survey.coordinate_systems import WGS84, coordinate_system_of

CHECK_PREFIX = "CHK-"
_LARGEST = 1e8
_FEWEST = 6
"""Columns of a line without a name."""


@dataclass(frozen=True, slots=True, eq=False)
class ControlPoints(Declared):
    """Surveyed points, and where images show them."""

    name: tuple[str, ...]
    coordinates: Float64[np.ndarray, "n 3"]
    """Longitude or easting, latitude or northing, height in meters; NaN if unknown."""
    crs: str
    """Their coordinate system: empty for WGS84, LOCAL, EPSG:number or a PROJ string."""
    is_check: Bool[np.ndarray, " n"]
    """Points that only check the result."""
    point: Int64[np.ndarray, " k"]
    """Point of each observation."""
    image: tuple[str, ...]
    """Image name of each observation."""
    pixels: Float64[np.ndarray, "k 2"]
    """Pixel of each observation."""
    is_normalized: bool = False
    """Whether `pixels` are relative to the center of the image, in units of its longer side."""

    def __len__(self) -> int:
        return len(self.name)

    def __repr__(self) -> str:
        return f"ControlPoints({len(self)} points, {len(self.point)} observations, {self.crs or 'WGS84'})"


@checked
def read_control_points(path: str | Path) -> ControlPoints:
    """Read control points in one of the formats of OpenSfM and OpenDroneMap.

    Raises:
        FileFormatError: the file is malformed, names no coordinate system, has two points of one name, or no points.
    """
    path = Path(path)
    text = file_text(path)
    if text.lstrip().startswith("{"):
        return _points_of_json(path, read_json(path))
    return _points_of_list(path, text)


class _Collected:
    """Points and observations while a file is read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: dict[str, int] = {}
        self.coordinates: list[tuple[float, float, float]] = []
        self.point: list[int] = []
        self.image: list[str] = []
        self.pixels: list[tuple[float, float]] = []
        self._seen: set[tuple[int, str]] = set()

    def add_point(self, where: str, name: str, coordinates: tuple[float, float, float]) -> int:
        row = self.rows.setdefault(name, len(self.coordinates))
        if row == len(self.coordinates):
            self.coordinates.append(coordinates)
        elif not np.array_equal(self.coordinates[row], coordinates, equal_nan=True):
            raise FileFormatError(
                self.path,
                f"{where}: the point {name} has the coordinates {_words(coordinates)} here, but "
                f"{_words(self.coordinates[row])} above; give different points different names",
            )
        return row

    def add_observation(self, where: str, row: int, image: str, pixel: tuple[float, float]) -> None:
        if (row, image) in self._seen:
            name = list(self.rows)[row]
            raise FileFormatError(self.path, f"{where}: the point {name} in {image} is given twice")
        self._seen.add((row, image))
        self.point.append(row)
        self.image.append(image)
        self.pixels.append(pixel)

    def finish(self, crs: str, *, is_normalized: bool) -> ControlPoints:
        if not self.coordinates:
            raise FileFormatError(self.path, "it contains no control points")
        names = tuple(self.rows)
        return ControlPoints(
            names,
            np.array(self.coordinates, np.float64),
            crs,
            np.array([name.upper().startswith(CHECK_PREFIX) for name in names], bool),
            np.array(self.point, np.int64),
            tuple(self.image),
            np.array(self.pixels, np.float64).reshape(-1, 2),
            is_normalized,
        )


def _points_of_list(path: Path, text: str) -> ControlPoints:
    lines = [(n, line.strip()) for n, line in enumerate(text.splitlines(), 1)]
    lines = [(n, line) for n, line in lines if line and not line.startswith("#")]
    if not lines:
        raise FileFormatError(path, "it is empty")
    crs = coordinate_system_of(path, lines[0][1])
    found = _Collected(path)
    name_at: dict[tuple[float, float, float], str] = {}
    for number, line in lines[1:]:
        words, where = (line.split("\t") if "\t" in line else line.split()), f"line {number}"
        words = [word.strip() for word in words if word.strip()]
        if len(words) < _FEWEST:
            raise FileFormatError(
                path, f"{where}: expected x y z pixel_x pixel_y image [name], got {line[:80]!r}"
            )
        x, y, u, v = (_number(path, where, words[k]) for k in (0, 1, 3, 4))
        z = math.nan if words[2].lower() == "nan" else _number(path, where, words[2])
        name = words[_FEWEST] if len(words) > _FEWEST else f"point {len(name_at) + 1}"
        key = (x, y, 0.0 if math.isnan(z) else z)
        if len(words) > _FEWEST:
            _require_one_name(path, where, name, name_at.setdefault(key, name))
        else:
            name = name_at.setdefault(key, name)
        found.add_observation(where, found.add_point(where, name, (x, y, z)), words[5], (u, v))
    return found.finish(crs, is_normalized=False)


def _require_one_name(path: Path, where: str, name: str, earlier: str) -> None:
    if name != earlier:
        raise FileFormatError(
            path,
            f"{where}: the points {earlier} and {name} have the same coordinates; name a point in all its lines or in none, and separate "
            "the columns by tabs if image names have spaces",
        )


def _points_of_json(path: Path, content: Any) -> ControlPoints:
    points = content.get("points") if isinstance(content, dict) else None
    if not isinstance(points, list):
        raise FileFormatError(path, 'expected {"points": [...]} as written by OpenSfM')
    found = _Collected(path)
    for number, entry in enumerate(points):
        where = f"points[{number}]"
        position = entry.get("position") if isinstance(entry, dict) else None
        if position is None and isinstance(entry, dict):
            continue  # a point that was marked in images, but not surveyed
        if not isinstance(position, dict):
            raise FileFormatError(path, f"{where}: the position must have latitude and longitude")
        lat, lon = (_number(path, where, position.get(key)) for key in ("latitude", "longitude"))
        altitude = position.get("altitude")
        alt = math.nan if altitude is None else _number(path, where, altitude)
        name = str(entry.get("id", f"point {number + 1}"))
        if name in found.rows:
            raise FileFormatError(path, f"{where}: there are two points of the name {name}")
        row = found.add_point(where, name, (lon, lat, alt))
        for observation in _list_of(path, where, entry.get("observations", [])):
            image, projection = observation.get("shot_id"), observation.get("projection")
            if not isinstance(image, str) or not isinstance(projection, list) or len(projection) != 2:
                raise FileFormatError(
                    path, f"{where}: an observation needs a shot_id and two numbers as projection"
                )
            pixel = (_number(path, where, projection[0]), _number(path, where, projection[1]))
            found.add_observation(where, row, image, pixel)
    return found.finish(WGS84, is_normalized=True)


def _list_of(path: Path, where: str, content: Any) -> list[dict[str, Any]]:
    if not (isinstance(content, list) and all(isinstance(one, dict) for one in content)):
        raise FileFormatError(path, f"{where}: observations must be a list of objects")
    return content


def _number(path: Path, where: str, word: Any) -> float:
    try:
        value = float(word) if not isinstance(word, bool) else math.nan
    except (TypeError, ValueError):
        value = math.nan
    if not abs(value) < _LARGEST:
        raise FileFormatError(path, f"{where}: {str(word)[:40]!r} is not a finite number")
    return value


def _words(coordinates: tuple[float, float, float]) -> str:
    return " ".join(f"{value:.10g}" for value in coordinates)
