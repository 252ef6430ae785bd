"""Contour lines of height rasters, as GeoPackage files (OGC 12-128), by way of contourpy and pyogrio."""

from __future__ import annotations

import math
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from epipole._checks import checked
from epipole.errors import ConfigError, EpipoleError, MissingDependencyError, ShapeError
from epipole.io.atomic import atomic_write
from epipole.io.survey.rasters import Raster

LAYER = "contours"
"""Name of the layer of lines."""
ELEVATION = "elevation"
"""Name of the lines' attribute with their height."""
_MOST_LEVELS = 5000
"""Largest number of levels; each takes a pass over the raster. 5 km of heights at an interval of 1 m."""
_MOST_DEFAULT_LEVELS = 40
"""Largest number of levels of the default interval; its steps of at most 2.5 make it at least 16."""
_DIGITS = 12
"""Significant digits of a level, so that 3 * 0.1 is 0.3."""
_LITTLE_ENDIAN, _LINE_STRING = 1, 2
"""Codes of well-known binary (WKB)."""
_TEMPORARY = ("-journal", "-wal", "-shm")
"""Suffixes of files that SQLite may leave after an error."""


class ContourLine(NamedTuple):
    """A line of constant height; closed if its first and last points are equal."""

    elevation: float
    """In meters, the unit of the raster's heights."""
    points: Float64[np.ndarray, "n 2"]
    """Easting and northing; higher ground is on the right."""


@checked
def write_contours(path: str | Path, raster: Raster, interval: float) -> None:
    """Write the contour lines of a height raster as a GeoPackage, which GIS programs show on the map.

    The layer `contours` has two-dimensional lines with their height in the attribute `elevation`, as GDAL's
    `gdal_contour`. See `contour_lines` for the lines. If no multiple of the interval lies between the lowest and the
    highest height, the layer is empty.

    Args:
        path: the file, usually with the suffix `.gpkg`.
        raster: heights in meters, NaN where they are unknown.
        interval: height between two levels in meters.

    Raises:
        ConfigError: the interval is not positive or gives too many levels, or the coordinate system is unknown.
        ShapeError: the raster has colors, or no known height.
        WorkspaceError: the file cannot be written.
        MissingDependencyError: contourpy or pyogrio is not installed.
    """
    _, pyogrio = _modules()
    lines = contour_lines(raster, interval)
    geometry = np.empty(len(lines), object)
    geometry[:] = [_wkb(line.points) for line in lines]
    elevations = np.array([line.elevation for line in lines], np.float64)
    with atomic_write(path) as part, _written_by_gdal(pyogrio, raster, part), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "'crs' was not provided")
        warnings.filterwarnings("ignore", ".*does not have the recommended .*extension")
        pyogrio.raw.write(
            str(part),
            geometry,
            [elevations],
            [ELEVATION],
            layer=LAYER,
            driver="GPKG",
            geometry_type="LineString",
            crs=raster.crs,
        )


@checked
def contour_lines(raster: Raster, interval: float) -> list[ContourLine]:
    """Lines of constant height at the multiples of an interval, by linear interpolation between pixel centers.

    Lines are where all four neighboring pixels are known, so they end at the edges of areas without data. The line of
    a level separates heights above the level from others.

    Args:
        raster: heights in meters, NaN where they are unknown.
        interval: height between two levels in meters.

    Returns:
        The lines, from the lowest level to the highest.

    Raises:
        ConfigError: the interval is not positive, or gives too many levels.
        ShapeError: the raster has colors, or no known height.
        MissingDependencyError: contourpy or pyogrio is not installed.
    """
    contourpy, _ = _modules()
    levels = _levels(raster, interval)
    if min(raster.values.shape) < 2:
        return []
    heights = np.ma.masked_invalid(raster.values.astype(np.float64))
    generator = contourpy.contour_generator(
        z=heights, name="serial", corner_mask=False, line_type=contourpy.LineType.Separate
    )
    corner = np.array([raster.x_min, raster.y_max])
    step = np.array([raster.resolution_m, -raster.resolution_m])
    out = []
    for level in levels:
        for pixels in generator.lines(level):
            is_new = np.ones(len(pixels), bool)
            is_new[1:] = (pixels[1:] != pixels[:-1]).any(axis=1)
            if is_new.sum() > 1:  # a pit of exactly this height gives a single point
                out.append(ContourLine(level, corner + (pixels[is_new] + 0.5) * step))
    return out


@checked
def default_interval(raster: Raster) -> float:
    """An interval for contour lines: 1, 2 or 5 times a power of ten, with 16 to 40 levels between the extreme heights.

    Args:
        raster: heights in meters, NaN where they are unknown.

    Returns:
        The interval in meters; 1 if all heights are equal.

    Raises:
        ShapeError: the raster has colors, or no known height.
    """
    lowest, highest = _range(raster)
    least = (highest - lowest) / _MOST_DEFAULT_LEVELS
    if least == 0:
        return 1.0
    exponent = math.floor(math.log10(least))
    candidates = [float(f"{digit}e{power}") for power in (exponent, exponent + 1) for digit in (1, 2, 5)]
    return next(each for each in candidates if each >= least)


@checked
def check_interval(interval: float, lowest: float, highest: float) -> None:
    """Check that contour lines between two heights in meters are not too many.

    Raises:
        ConfigError: the interval is not positive, or gives too many levels.
    """
    if not 0 < interval < math.inf:
        raise ConfigError(f"interval must be positive and finite, got {interval:g}")
    count = (highest - lowest) / interval
    if count > _MOST_LEVELS:
        least = (highest - lowest) / _MOST_LEVELS
        raise ConfigError(
            f"an interval of {interval:g} m gives {count:.3g} levels between {lowest:g} m and {highest:g} m, and at "
            f"most {_MOST_LEVELS} are possible: use an interval of at least {least:.3g} m"
        )


def require_contours() -> None:
    """Check that contourpy and pyogrio are installed, before work whose result needs them.

    Raises:
        MissingDependencyError: one is not.
    """
    _modules()


def _modules() -> tuple[Any, Any]:
    """The modules contourpy and pyogrio."""
    try:
        import contourpy
        import pyogrio
        import pyogrio.errors
        import pyogrio.raw
    except ImportError as error:
        problem = "contour lines need the packages contourpy and pyogrio: pip install 'epipole[survey]'"
        raise MissingDependencyError(problem) from error
    return contourpy, pyogrio


def _range(raster: Raster) -> tuple[float, float]:
    """The lowest and the highest height."""
    if raster.is_color:
        raise ShapeError(f"contour lines need heights (h, w), got colors {raster.values.shape}")
    known = raster.values[np.isfinite(raster.values)]
    if not len(known):
        raise ShapeError("the raster has no known height, so it has no contour lines")
    return float(known.min()), float(known.max())


def _levels(raster: Raster, interval: float) -> list[float]:
    """The multiples of the interval between the lowest and the highest height."""
    lowest, highest = _range(raster)
    check_interval(interval, lowest, highest)
    first, last = math.ceil(lowest / interval), math.floor(highest / interval)
    return [float(f"{k * interval:.{_DIGITS}g}") for k in range(first, last + 1)]


def _wkb(points: np.ndarray) -> bytes:
    """A line string in well-known binary."""
    header = struct.pack("<BII", _LITTLE_ENDIAN, _LINE_STRING, len(points))
    return header + np.ascontiguousarray(points, "<f8").tobytes()


@contextmanager
def _written_by_gdal(pyogrio: Any, raster: Raster, part: Path) -> Iterator[None]:
    """Convert the exceptions of GDAL, and remove the temporary files that SQLite leaves after an error.

    Raises:
        ConfigError: the coordinate system is unknown.
        OSError: GDAL cannot write the file.
    """
    try:
        yield
    except (EpipoleError, OSError):
        raise
    except pyogrio.errors.CRSError as error:
        crs = str(raster.crs)[:80]
        raise ConfigError(f"crs is {crs!r}, which is unknown: use a code such as EPSG:32632") from error
    except Exception as error:  # GDAL's exceptions have no public base class
        words = str(error).strip().splitlines() or [type(error).__name__]
        raise OSError(f"GDAL reports: {words[0]}") from error
    finally:
        for suffix in _TEMPORARY:
            part.with_name(part.name + suffix).unlink(missing_ok=True)
