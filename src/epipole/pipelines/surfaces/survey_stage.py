"""Last stage, for georeferenced models: height and terrain model, contour lines, orthophoto and points in a coordinate system."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from epipole.dense.orthophoto import TopView, top_view
from epipole.dense.terrain import terrain_model
from epipole.errors import ConfigError
from epipole.io.survey.contours import default_interval, require_contours, write_contours
from epipole.io.survey.coordinate_systems import LOCAL, WGS84, coordinates_of, has_meters
from epipole.io.survey.point_clouds import LazChunk, require_laspy, write_laz_chunks
from epipole.io.survey.rasters import Raster, require_rasterio, write_geotiff
from epipole.pipelines.surfaces.cloud_stage import points_in
from epipole.pipelines.surfaces.config import SurfaceConfig
from epipole.pipelines.surfaces.inputs import SurfaceInputs
from epipole.pipelines.surfaces.survey_extent import check_extent
from epipole.runs import Unit
from epipole.scene import Georeference
from epipole.scene.textured_mesh import TexturedMesh

SMOOTH_CELLS = 2.0
"""Standard deviation of the smoothing of contour lines, in cells."""
CELL_PIXELS = 1.0
"""Side of a cell, in pixels at the median depth of all views."""


def require_georeference(inputs: SurfaceInputs, config: SurfaceConfig) -> Georeference:
    """The georeference of the model.

    Raises:
        ConfigError: there is none, or the coordinate system has degrees.
        MissingDependencyError: pyproj is not installed.
        FileFormatError: the coordinate system is unknown.
    """
    found = inputs.model.georeference
    if found is None:
        raise ConfigError(
            "survey products need a model with a position on Earth: run `epipole georeference` first, or reconstruct images with GPS"
        )
    crs = crs_of(found, config)
    if not has_meters(crs):
        raise ConfigError(
            f"{crs} has degrees, but the cells of height models are in meters: pass a projection (--crs)"
        )
    coordinates_of(np.array([[found.lat_deg, found.lon_deg, found.alt_m]]), crs)
    return found


def check_survey(inputs: SurfaceInputs, config: SurfaceConfig) -> None:
    """Check that survey products are possible, before depth is computed.

    Raises:
        ConfigError: the model has no position on Earth, no image shows the crop, or contour lines are too many.
        MissingDependencyError: pyproj is not installed.
        FileFormatError: the coordinate system is unknown.
    """
    origin = require_georeference(inputs, config)
    check_extent(inputs, origin, crs_of(origin, config), config)


def require_survey_packages() -> None:
    """Check that the packages for survey files are installed.

    Raises:
        MissingDependencyError: one is not.
    """
    require_rasterio()
    require_laspy()
    require_contours()


def crs_of(origin: Georeference, config: SurfaceConfig) -> str:
    """The requested coordinate system, else that of the control points if it has meters, else the UTM zone of the origin."""
    if config.crs is not None:
        return config.crs
    if origin.crs not in (WGS84, LOCAL) and has_meters(origin.crs):
        return origin.crs
    zone = int(np.clip(np.floor((origin.lon_deg + 180.0) / 6.0) + 1, 1, 60))
    return f"EPSG:{32600 + zone if origin.lat_deg >= 0 else 32700 + zone}"


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """Height model, terrain model and orthophoto on one grid, as written."""

    heights: Raster
    terrain: Raster
    orthophoto: Raster
    facts: dict[str, Any]
    """Entries of `summary.json`."""


def write_survey(
    folder: Path,
    mesh: TexturedMesh,
    clouds: Mapping[int, Unit],
    inputs: SurfaceInputs,
    pixel_m: float,
    config: SurfaceConfig,
) -> Survey:
    """Write `dsm.tif`, `dtm.tif`, `contours.gpkg`, `orthophoto.tif` and `cloud.laz`.

    Raises:
        WorkspaceError: a file cannot be written.
        ConfigError: the resolution is too fine for the scene, or nothing is inside the crop.
    """
    origin = require_georeference(inputs, config)
    crs = crs_of(origin, config)
    resolution = config.resolution_m or _rounded(CELL_PIXELS * pixel_m)
    positions = coordinates_of(origin.lat_lon_alt_of(mesh.vertices_in_world), crs)
    seen = _cropped(top_view(mesh, positions, resolution), config.crop, crs)
    corner = seen.x_min, seen.y_max, seen.resolution, crs
    alpha = np.where(seen.is_known, np.uint8(255), np.uint8(0))[..., None]
    heights = Raster(seen.height, *corner)
    terrain = Raster(terrain_model(seen.height, seen.resolution), *corner)
    orthophoto = Raster(np.concatenate([seen.rgb, alpha], axis=2), *corner)
    rasters = {"dsm.tif": heights, "dtm.tif": terrain, "orthophoto.tif": orthophoto}
    for name, raster in rasters.items():
        write_geotiff(folder / name, raster)
    interval = config.contour_m or default_interval(terrain)
    write_contours(folder / "contours.gpkg", _smooth(terrain), interval)
    write_laz_chunks(folder / "cloud.laz", _chunks(clouds, origin, crs, config.crop), crs=crs)
    height, width = seen.height.shape
    facts: dict[str, Any] = {"crs": crs, "resolution_m": resolution, "raster_size": [width, height]}
    facts |= {"gsd_m": pixel_m, "contour_m": interval, "area_m2": float(seen.is_known.sum()) * resolution**2}
    return Survey(heights, terrain, orthophoto, facts)


def _cropped(view: TopView, crop: tuple[float, float, float, float] | None, crs: str) -> TopView:
    """The cells whose centers are within the borders."""
    if crop is None:
        return view
    west, south, east, north = crop
    height, width = view.height.shape
    x = view.x_min + (np.arange(width) + 0.5) * view.resolution
    y = view.y_max - (np.arange(height) + 0.5) * view.resolution
    columns, rows = (
        np.flatnonzero((a >= low) & (a <= high)) for a, low, high in ((x, west, east), (y, south, north))
    )
    if not (len(columns) and len(rows) and view.is_known[np.ix_(rows, columns)].any()):
        raise ConfigError(
            f"nothing is inside the crop: the surface is from {x[0]:.0f}, {y[-1]:.0f} to {x[-1]:.0f}, {y[0]:.0f} in {crs}"
        )
    part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    return TopView(
        np.ascontiguousarray(view.height[part]),
        np.ascontiguousarray(view.rgb[part]),
        np.ascontiguousarray(view.is_known[part]),
        view.x_min + float(columns[0]) * view.resolution,
        view.y_max - float(rows[0]) * view.resolution,
        view.resolution,
    )


def _smooth(terrain: Raster) -> Raster:
    """Heights averaged over a few cells, so that contour lines do not show the noise of single cells."""
    known = np.isfinite(terrain.values).astype(np.float32)
    total = cv2.GaussianBlur(np.nan_to_num(terrain.values) * known, (0, 0), SMOOTH_CELLS)
    weight = cv2.GaussianBlur(known, (0, 0), SMOOTH_CELLS)
    with np.errstate(invalid="ignore", divide="ignore"):
        return replace(terrain, values=np.where(known > 0, total / weight, np.float32(np.nan)))


def _chunks(
    clouds: Mapping[int, Unit],
    origin: Georeference,
    crs: str,
    crop: tuple[float, float, float, float] | None,
) -> Iterator[LazChunk]:
    west, south, east, north = crop or (-np.inf, -np.inf, np.inf, np.inf)
    for points in points_in(list(clouds.values())):
        if len(points):
            xyz = coordinates_of(origin.lat_lon_alt_of(points.points_in_world), crs)
            kept = (xyz[:, 0] >= west) & (xyz[:, 0] <= east) & (xyz[:, 1] >= south) & (xyz[:, 1] <= north)
            yield LazChunk(xyz[kept], points.rgb[kept], points.sigma[kept])


def _rounded(length: float) -> float:
    """The length, rounded up to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= length * (1 - 1e-9)))
