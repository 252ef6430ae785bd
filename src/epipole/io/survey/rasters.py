"""Rasters on a map, as cloud-optimized GeoTIFF files: orthophotos and height models, by way of rasterio.

A cloud-optimized GeoTIFF (OGC 21-026) has internal tiles and overviews, so that a GIS shows a part of a large file without
reading all of it.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from epipole._checks import check_fields, checked
from epipole._parallel import num_threads
from epipole.errors import ConfigError, EpipoleError, FileFormatError, MissingDependencyError, ShapeError
from epipole.io.atomic import atomic_write
from epipole.io.files import SMALL_BYTES, read_by_others, require_file

TILE_SIZE = 512
"""Width and height of the internal tiles in pixels."""
_MOST_RATIO = 1032
"""Largest compression ratio of deflate, which constant areas reach."""
_SQUARE = 1e-6
"""Largest relative difference between the width and the height of a pixel."""
_TEMPORARY = (".ovr.tmp", ".msk.ovr.tmp", ".aux.xml")
"""Suffixes of files that GDAL may leave after an error."""


@dataclass(frozen=True, slots=True, eq=False)
class Raster:
    """Heights or colors on a regular grid in the plane of a map; rows run from north to south."""

    values: Float32[np.ndarray, "h w"] | UInt8[np.ndarray, "h w c"]
    """Heights in meters, NaN without data; or colors, RGB or RGBA, 0 to 255."""
    x_min: float
    """Easting of the outer corner of the top-left pixel."""
    y_max: float
    """Northing of the outer corner of the top-left pixel."""
    resolution_m: float
    """Width and height of a pixel, in the unit of the coordinate system."""
    crs: str | None = None
    """Coordinate system, such as EPSG:32632, or WKT; None if it is unknown."""

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            ShapeError: there are no pixels, colors are neither RGB nor RGBA, or a height is infinite.
            ConfigError: a coordinate is not finite, or the resolution is not positive.
        """
        check_fields(self)
        shape = self.values.shape
        if not self.values.size:
            raise ShapeError(f"values must have at least one pixel, got {shape}")
        if len(shape) == 3 and shape[2] not in (3, 4):
            raise ShapeError(f"values must be heights (h, w), or colors (h, w, 3) or (h, w, 4), got {shape}")
        if len(shape) == 2 and np.isinf(self.values).any():
            raise ShapeError("values must not be infinite; use NaN where there is no data")
        if not (math.isfinite(self.x_min) and math.isfinite(self.y_max)):
            raise ConfigError(f"x_min and y_max must be finite, got {self.x_min:g} and {self.y_max:g}")
        if not 0 < self.resolution_m < math.inf:
            raise ConfigError(f"resolution_m must be positive and finite, got {self.resolution_m:g}")

    @property
    def is_color(self) -> bool:
        """Whether the values are colors."""
        return self.values.ndim == 3

    def __repr__(self) -> str:
        height, width = self.values.shape[:2]
        kind = "colors" if self.is_color else "heights"
        return f"Raster({width} x {height} {kind}, {self.resolution_m:g} m, {self.crs or 'unknown CRS'})"


@checked
def write_geotiff(path: str | Path, raster: Raster) -> None:
    """Write a raster as a cloud-optimized GeoTIFF: tiles of 512 x 512 pixels, overviews, lossless compression (deflate).

    Heights are single precision with NaN as the value for no data. The fourth channel of colors is the alpha band.

    Args:
        path: the file.
        raster: heights or colors, north up.

    Raises:
        ConfigError: the coordinate system is unknown.
        WorkspaceError: the file cannot be written.
        MissingDependencyError: rasterio is not installed.
    """
    rasterio = _rasterio()
    values = raster.values if raster.is_color else raster.values[:, :, None]
    (height, width, bands), size = values.shape, raster.resolution_m
    with rasterio.Env():
        options = {
            **{"driver": "COG", "height": height, "width": width, "count": bands, "dtype": values.dtype.name},
            **{"nodata": None if raster.is_color else math.nan, "crs": _known_crs(rasterio, raster.crs)},
            "transform": rasterio.Affine(size, 0.0, raster.x_min, 0.0, -size, raster.y_max),
            **{"blocksize": TILE_SIZE, "compress": "DEFLATE", "predictor": "YES", "bigtiff": "IF_SAFER"},
            **{"overview_resampling": "AVERAGE", "num_threads": num_threads()},
        }
        with atomic_write(path) as part, _written_by_gdal(part), warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)  # x_min = y_max = 0
            with rasterio.open(part, "w", **options) as out:
                for band in range(bands):
                    out.write(values[:, :, band], band + 1)
                if raster.is_color:
                    kinds = rasterio.enums.ColorInterp
                    out.colorinterp = [kinds.red, kinds.green, kinds.blue, kinds.alpha][:bands]


@checked
def read_geotiff(path: str | Path) -> Raster:
    """Read a GeoTIFF with heights (one band) or colors (three or four 8-bit bands), north up with square pixels.

    Heights become single precision, with NaN where the file has no data. Colors have an alpha channel if the file has an
    alpha band or a mask.

    Args:
        path: the file.

    Raises:
        FileFormatError: not a readable GeoTIFF, other bands, or no georeference with square pixels and north up.
        MissingDependencyError: rasterio is not installed.
    """
    path = Path(path)
    rasterio = _rasterio()
    num_bytes = require_file(path)
    with (
        read_by_others(path, "not a readable GeoTIFF"),
        rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR"),  # no other file describes this one
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(path.resolve(), driver="GTiff") as source:
            _require_room(path, source, num_bytes)
            x_min, y_max, resolution_m = _corner_and_resolution(path, source.transform)
            if source.count == 1 and np.dtype(source.dtypes[0]).kind in "iuf":
                values = _heights(source)
            elif source.count in (3, 4) and set(source.dtypes) == {"uint8"}:
                values = _colors(rasterio, source)
            else:
                bands = ", ".join(source.dtypes[:8])
                problem = f"expected one band of heights, or three or four 8-bit bands of colors, got {bands}"
                raise FileFormatError(path, problem)
            return Raster(values, x_min, y_max, resolution_m, _crs_text(source.crs))


def require_rasterio() -> None:
    """Check that rasterio is installed, before work whose result needs it.

    Raises:
        MissingDependencyError: it is not.
    """
    _rasterio()


def _rasterio() -> Any:
    try:
        import rasterio
        import rasterio.enums
        import rasterio.errors
    except ImportError as error:
        problem = "GeoTIFF files need the package rasterio: pip install 'epipole[survey]'"
        raise MissingDependencyError(problem) from error
    return rasterio


def _known_crs(rasterio: Any, crs: str | None) -> Any:
    if crs is None:
        return None
    try:
        return rasterio.crs.CRS.from_user_input(crs)
    except rasterio.errors.CRSError as error:
        raise ConfigError(f"crs is {crs[:80]!r}, which is unknown: use a code such as EPSG:32632") from error


def _crs_text(crs: Any) -> str | None:
    """EPSG:number if the coordinate system has one, else WKT."""
    if not crs:
        return None
    number = crs.to_epsg(confidence_threshold=100)
    return f"EPSG:{number}" if number is not None else str(crs.to_wkt())


@contextmanager
def _written_by_gdal(part: Path) -> Iterator[None]:
    """Convert GDAL's exceptions, and remove the temporary files that it leaves after an error.

    Raises:
        OSError: GDAL cannot write the file.
    """
    try:
        yield
    except (EpipoleError, OSError):
        raise
    except Exception as error:  # GDAL's exceptions have no public base class
        words = str(error).strip().splitlines() or [type(error).__name__]
        raise OSError(f"GDAL reports: {words[0]}") from error
    finally:
        for suffix in _TEMPORARY:
            part.with_name(part.name + suffix).unlink(missing_ok=True)


def _require_room(path: Path, source: Any, num_bytes: int) -> None:
    """Check sizes before memory is allocated: a few bytes can declare a raster of any size.

    Raises:
        FileFormatError: the raster or a tile is larger than the file can contain.
    """
    most = max(SMALL_BYTES, _MOST_RATIO * num_bytes)
    item = sum(np.dtype(kind).itemsize for kind in source.dtypes)
    for height, width in [(source.height, source.width), *source.block_shapes]:
        if height * width * item > most:
            problem = f"{width} x {height} pixels do not fit into a file of {num_bytes} bytes"
            raise FileFormatError(path, problem)


def _corner_and_resolution(path: Path, grid: Any) -> tuple[float, float, float]:
    """X and y of the top-left corner, and the size of a pixel."""
    is_square = abs(grid.a + grid.e) <= _SQUARE * abs(grid.a)
    if not (grid.a > 0 > grid.e and grid.b == grid.d == 0 and is_square and np.isfinite(grid).all()):
        numbers = ", ".join(f"{value:g}" for value in tuple(grid)[:6])
        problem = (
            f"no georeference with north up and square pixels (affine map {numbers}); warp it with gdalwarp"
        )
        raise FileFormatError(path, problem)
    return float(grid.c), float(grid.f), float(grid.a)


def _heights(source: Any) -> Float32[np.ndarray, "h w"]:
    values: np.ndarray = source.read(1, out_dtype="float32")
    if source.scales[0] != 1.0 or source.offsets[0] != 0.0:
        values = (source.scales[0] * values + source.offsets[0]).astype(np.float32)
    values[(source.read_masks(1) == 0) | ~np.isfinite(values)] = np.nan
    return values


def _colors(rasterio: Any, source: Any) -> UInt8[np.ndarray, "h w c"]:
    is_alpha = source.count == 4 and source.colorinterp[3] == rasterio.enums.ColorInterp.alpha
    is_masked = rasterio.enums.MaskFlags.all_valid not in source.mask_flag_enums[0]
    values = np.empty((source.height, source.width, 4 if is_alpha or is_masked else 3), np.uint8)
    for band in range(3):
        values[:, :, band] = source.read(band + 1)
    if values.shape[2] == 4:
        values[:, :, 3] = source.read(4) if is_alpha else source.dataset_mask()
    return values
