"""Last stage, for georeferenced models: height model, orthophoto and points in a coordinate system."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from epipole.dense.orthophoto import top_view
from epipole.errors import ConfigError
from epipole.io.survey.coordinate_systems import LOCAL, WGS84, coordinates_of, has_meters
from epipole.io.survey.point_clouds import LazChunk, require_laspy, write_laz_chunks
from epipole.io.survey.rasters import Raster, require_rasterio, write_geotiff
from epipole.pipelines.surfaces.cloud_stage import points_in
from epipole.pipelines.surfaces.config import SurfaceConfig
from epipole.pipelines.surfaces.inputs import SurfaceInputs
from epipole.runs import Unit
from epipole.scene import Georeference
from epipole.scene.textured_mesh import TexturedMesh

CELL_PIXELS = 1.0
"""Side of a cell, in pixels at the median depth of all views."""


def require_georeference(inputs: SurfaceInputs, config: SurfaceConfig) -> Georeference:
    """The georeference of the model, before anything else is computed.

    Raises:
        ConfigError: there is none.
        MissingDependencyError: a package for survey files is not installed.
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
    require_rasterio()
    require_laspy()
    return found


def crs_of(origin: Georeference, config: SurfaceConfig) -> str:
    """The requested coordinate system, else that of the control points if it has meters, else the UTM zone of the origin."""
    if config.crs is not None:
        return config.crs
    if origin.crs not in (WGS84, LOCAL) and has_meters(origin.crs):
        return origin.crs
    zone = int(np.clip(np.floor((origin.lon_deg + 180.0) / 6.0) + 1, 1, 60))
    return f"EPSG:{32600 + zone if origin.lat_deg >= 0 else 32700 + zone}"


def write_survey(
    folder: Path,
    mesh: TexturedMesh,
    clouds: Mapping[int, Unit],
    inputs: SurfaceInputs,
    pixel_m: float,
    config: SurfaceConfig,
) -> dict[str, Any]:
    """Write `dsm.tif`, `orthophoto.tif` and `cloud.laz`; returns their coordinate system and resolution.

    Raises:
        WorkspaceError: a file cannot be written.
        ConfigError: the resolution is too fine for the scene.
    """
    origin = require_georeference(inputs, config)
    crs = crs_of(origin, config)
    resolution = config.resolution_m or _rounded(CELL_PIXELS * pixel_m)
    positions = coordinates_of(origin.lat_lon_alt_of(mesh.vertices_in_world), crs)
    seen = top_view(mesh, positions, resolution)
    corner = seen.x_min, seen.y_max, seen.resolution, crs
    write_geotiff(folder / "dsm.tif", Raster(seen.height, *corner))
    alpha = np.where(seen.is_known, np.uint8(255), np.uint8(0))[..., None]
    write_geotiff(folder / "orthophoto.tif", Raster(np.concatenate([seen.rgb, alpha], axis=2), *corner))
    write_laz_chunks(folder / "cloud.laz", _chunks(clouds, origin, crs), crs=crs)
    height, width = seen.height.shape
    return {"crs": crs, "resolution_m": resolution, "raster_size": [width, height]}


def _chunks(clouds: Mapping[int, Unit], origin: Georeference, crs: str) -> Iterator[LazChunk]:
    for points in points_in(list(clouds.values())):
        if len(points):
            positions = coordinates_of(origin.lat_lon_alt_of(points.points_in_world), crs)
            yield LazChunk(positions, points.rgb, points.sigma)


def _rounded(length: float) -> float:
    """The length, rounded up to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= length * (1 - 1e-9)))
