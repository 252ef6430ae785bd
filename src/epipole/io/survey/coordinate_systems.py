"""Coordinate systems of control points: WGS84, local meters, and projections by way of pyproj."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_points, checked
from epipole.errors import FileFormatError, MissingDependencyError

WGS84 = ""
"""Longitude and latitude in degrees, and altitude in meters."""
LOCAL = "LOCAL"
"""Meters along x, y and z (up), at an unknown position on Earth."""
_UTM = re.compile(r"WGS\s*84\s*[/ ]\s*UTM\s+(?:zone\s+)?(\d{1,2})\s*([NS])", re.IGNORECASE)
_OTHER_HEIGHTS = re.compile(r"\+vunits=(?!m\b)|\+vto_meter=")
"""Units of heights other than meters in a PROJ string, which pyproj drops with the vertical axis."""
_EPSG = re.compile(r"EPSG:\s*(\d{4,6})", re.IGNORECASE)


@checked
def coordinate_system_of(path: str | Path, words: str) -> str:
    """The coordinate system that the first line of a file names: WGS84, LOCAL, EPSG:number or a PROJ string.

    Raises:
        FileFormatError: it is not a known coordinate system.
    """
    text = words.strip()
    if text.upper().replace(" ", "") in ("WGS84", "EPSG:4326", "EPSG:4979"):
        return WGS84
    if text.upper() == LOCAL:
        return LOCAL
    if found := _UTM.fullmatch(text):
        zone = int(found[1])
        if 1 <= zone <= 60:
            return f"EPSG:{(32600 if found[2].upper() == 'N' else 32700) + zone}"
    if found := _EPSG.fullmatch(text):
        return f"EPSG:{int(found[1])}"
    if text.startswith("+proj="):
        return text
    raise FileFormatError(
        path,
        f"line 1 must name the coordinate system, got {text[:80]!r}: use WGS84, WGS84 UTM 32N, EPSG:25832, a PROJ string "
        "(+proj=...), or LOCAL for meters at an unknown position on Earth",
    )


@checked
def lat_lon_alt_of(
    path: str | Path, coordinates: Float64[np.ndarray, "n 3"], crs: str
) -> Float64[np.ndarray, "n 3"]:
    """Latitude and longitude (WGS84) in degrees; heights stay as given.

    Args:
        path: the file of the coordinates, for error messages.
        coordinates: east or longitude, north or latitude, and height in meters; NaN if unknown.
        crs: the coordinate system, as from `coordinate_system_of`, other than LOCAL.

    Raises:
        FileFormatError: pyproj does not know the coordinate system, or a point is outside it.
        MissingDependencyError: pyproj is not installed.
    """
    points = as_points(coordinates, "coordinates", 3)
    if crs == WGS84:
        out = points[:, [1, 0, 2]]
    else:
        lon, lat = _transformer(path, crs).transform(points[:, 0], points[:, 1])
        out = np.stack([lat, lon, points[:, 2]], axis=1)
    wrong = ~((np.abs(out[:, 0]) <= 90.0) & (np.abs(out[:, 1]) <= 360.0))
    if wrong.any():
        x, y, _ = points[int(np.argmax(wrong))]
        order = "longitude comes before latitude" if crs == WGS84 else "the easting comes before the northing"
        raise FileFormatError(
            path, f"the point {x:.10g} {y:.10g} is not in {crs or 'WGS84'}; {order} in this file"
        )
    return out


@checked
def coordinates_of(lat_lon_alt: Float64[np.ndarray, "n 3"], crs: str) -> Float64[np.ndarray, "n 3"]:
    """The inverse of `lat_lon_alt_of`.

    Args:
        lat_lon_alt: degrees, degrees, meters.
        crs: the coordinate system, other than LOCAL.

    Raises:
        FileFormatError: pyproj does not know the coordinate system.
        MissingDependencyError: pyproj is not installed.
    """
    table = as_points(lat_lon_alt, "lat_lon_alt", 3)
    if crs == WGS84:
        return table[:, [1, 0, 2]]
    x, y = _transformer(Path(crs), crs).transform(table[:, 1], table[:, 0], direction="INVERSE")
    return np.stack([x, y, table[:, 2]], axis=1)


@checked
def has_meters(crs: str) -> bool:
    """Whether the horizontal coordinates of a coordinate system are meters of a projection, rather than degrees.

    Args:
        crs: the coordinate system.

    Raises:
        FileFormatError: pyproj does not know the coordinate system.
        MissingDependencyError: pyproj is not installed.
    """
    if crs in (WGS84, LOCAL):
        return crs == LOCAL
    _transformer(Path(crs), crs)
    import pyproj

    found = pyproj.CRS.from_user_input(crs)
    horizontal = found.sub_crs_list[0] if found.is_compound else found
    return bool(horizontal.is_projected)


@checked
def is_in_area_of_use(crs: str, lat_deg: float, lon_deg: float) -> bool:
    """Whether a position is in the area for which a coordinate system is made; true if that is not known.

    Args:
        crs: the coordinate system.
        lat_deg: latitude.
        lon_deg: longitude, from -180 to 360.

    Raises:
        FileFormatError: pyproj does not know the coordinate system.
        MissingDependencyError: pyproj is not installed.
    """
    if crs in (WGS84, LOCAL):
        return True
    _transformer(Path(crs), crs)
    import pyproj

    area = pyproj.CRS.from_user_input(crs).area_of_use
    if area is None:
        return True
    east_of_west, span = (lon_deg - area.west) % 360.0, (area.east - area.west) % 360.0
    is_whole = area.east - area.west >= 360.0
    return area.south <= lat_deg <= area.north and (is_whole or east_of_west <= span)


@checked
def utm_zone(lat_deg: float, lon_deg: float) -> int:
    """Number of the UTM zone of a position, with the exceptions of Norway and Svalbard (DMA TM 8358.2, section 2-3)."""
    lon_deg = (lon_deg + 180.0) % 360.0 - 180.0
    if 56.0 <= lat_deg < 64.0 and 3.0 <= lon_deg < 12.0:
        return 32
    if 72.0 <= lat_deg <= 84.0 and 0.0 <= lon_deg < 42.0:
        return 31 + 2 * int(np.digitize(lon_deg, [9.0, 21.0, 33.0]))
    return int(np.floor((lon_deg + 180.0) / 6.0)) + 1


def _transformer(path: str | Path, crs: str) -> Any:
    """Transformer from a horizontal coordinate system to longitude and latitude.

    Raises:
        FileFormatError: the coordinate system is unknown, or its unit is not a meter.
        MissingDependencyError: pyproj is not installed.
    """
    try:
        import pyproj
    except ImportError as error:
        raise MissingDependencyError(f"{crs} needs pyproj: pip install 'epipole[survey]'") from error
    try:
        found = pyproj.CRS.from_user_input(crs)
        horizontal = found.sub_crs_list[0] if found.is_compound else found
        if found.is_geocentric:
            raise FileFormatError(
                path, f"{crs} is geocentric: use longitude, latitude and height, or a projection"
            )
        vertical = [axis for axis in found.axis_info if axis.direction in ("up", "down")]
        if any(
            axis.direction == "down" or not math.isclose(axis.unit_conversion_factor, 1.0)
            for axis in vertical
        ):
            raise FileFormatError(
                path, f"the heights of {crs} are not in meters, upward: convert the control points"
            )
        if _OTHER_HEIGHTS.search(crs):
            raise FileFormatError(path, f"the heights of {crs} are not in meters: convert the control points")
        units = [axis.unit_conversion_factor for axis in horizontal.axis_info[:2]]
        if horizontal.is_projected and not all(math.isclose(unit, 1.0) for unit in units):
            unit = horizontal.axis_info[0].unit_name
            raise FileFormatError(path, f"the unit of {crs} is {unit}: convert the control points to meters")
        return pyproj.Transformer.from_crs(horizontal, "EPSG:4326", always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise FileFormatError(path, f"pyproj does not know the coordinate system {crs}") from error
