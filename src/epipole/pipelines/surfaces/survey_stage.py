"""Last stage, for georeferenced models: height and terrain model, contour lines, orthophoto and points in a coordinate system."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from epipole.dense.orthophoto import TopView, top_view
from epipole.dense.terrain import terrain_model
from epipole.errors import ConfigError, DegenerateGeometryError
from epipole.io.survey.contours import default_interval, require_contours, write_contours
from epipole.io.survey.coordinate_systems import (
    LOCAL,
    WGS84,
    coordinates_of,
    has_meters,
    is_in_area_of_use,
    utm_zone,
)
from epipole.io.survey.point_clouds import require_laspy
from epipole.io.survey.rasters import Raster, require_rasterio, write_geotiff
from epipole.pipelines.surfaces.cloud_files import write_laz
from epipole.pipelines.surfaces.config import SurfaceConfig
from epipole.pipelines.surfaces.inputs import SurfaceInputs
from epipole.pipelines.surfaces.survey_extent import cells_within, check_cells, check_extent
from epipole.runs import Unit
from epipole.scene import Georeference
from epipole.scene.textured_mesh import TexturedMesh

MOST_SAMPLES, MOST_PER_SIDE = 1.2e7, 8
"""Samples of the view from above in all, which need 80 bytes each, and along a side of a cell, at most."""
FINE_CELLS, FINE_PIXELS = 5.0, 0.5
"""Voxels larger than this many cells, and cells smaller than this part of a pixel, are reported."""
SMOOTH_CELLS = 2.0
"""Standard deviation of the smoothing of contour lines, in cells."""
STEP_M, MOST_STRETCHED = 100.0, 0.01
"""Length on the ground whose image in the coordinate system is compared, and the largest relative difference."""
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


def check_survey(inputs: SurfaceInputs, config: SurfaceConfig) -> list[str]:
    """Check that survey products are possible, before depth is computed; returns warnings.

    Raises:
        ConfigError: the model has no position on Earth, the coordinate system is not for this area, no image shows the crop, or cells
            or contour lines are too many.
        MissingDependencyError: pyproj is not installed.
        FileFormatError: the coordinate system is unknown.
    """
    origin = require_georeference(inputs, config)
    notes = check_map(origin, config)
    check_extent(inputs, origin, crs_of(origin, config), config)
    return notes


def check_map(origin: Georeference, config: SurfaceConfig) -> list[str]:
    """Check that the coordinate system suits a position, before depth is computed; returns warnings.

    Raises:
        ConfigError: lengths in the coordinate system are not those on the ground.
        MissingDependencyError: pyproj is not installed.
        FileFormatError: the coordinate system is unknown.
    """
    crs = crs_of(origin, config)
    _check_scale(origin, crs)
    if is_in_area_of_use(crs, origin.lat_deg, origin.lon_deg):
        return []
    return [
        f"the model is outside the area for which {crs} is made: check --crs, or the first line of the control points"
    ]


def _check_scale(origin: Georeference, crs: str) -> None:
    """Check that lengths in a coordinate system are those on the ground.

    Raises:
        ConfigError: they differ by more than a percent.
    """
    steps = np.array([[0.0, 0.0, 0.0], [STEP_M, 0.0, 0.0], [0.0, STEP_M, 0.0]])
    found = coordinates_of(origin.lat_lon_alt_of(steps), crs)[:, :2]
    factors = np.linalg.norm(found[1:] - found[0], axis=1) / STEP_M
    if not np.abs(factors - 1.0).max() <= MOST_STRETCHED:
        raise ConfigError(
            f"{crs} shows lengths {factors[0]:.2f} times (east) and {factors[1]:.2f} times (north) as long as they are here, so cells and"
            " areas would be wrong: pass a projection for this area (--crs), such as its UTM zone, which is the default"
        )


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
    zone = utm_zone(origin.lat_deg, origin.lon_deg)
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
    seen = _view_from_above(mesh, positions, resolution, pixel_m, config, crs)
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
    write_laz(folder, clouds, origin, crs, config.crop)
    height, width = seen.height.shape
    facts: dict[str, Any] = {"crs": crs, "resolution_m": resolution, "raster_size": [width, height]}
    facts |= {"gsd_m": pixel_m * inputs.image_scale, "contour_m": interval}
    facts |= {"area_m2": float(seen.is_known.sum()) * resolution**2}
    return Survey(heights, terrain, orthophoto, facts)


def notes_on_cells(facts: Mapping[str, Any]) -> list[str]:
    """Warnings if the cells are finer than what the mesh or the images show.

    Args:
        facts: with `resolution_m`, `voxel` and `gsd_m`.
    """
    cell, voxel, gsd = facts["resolution_m"], facts["voxel"], facts["gsd_m"]
    if voxel > FINE_CELLS * cell:
        return [
            f"the cells of {cell:g} m are much finer than the mesh, whose voxels are {voxel:.2g} m: heights between them are interpolated"
            " (--voxel, --crop)"
        ]
    if cell < FINE_PIXELS * gsd:
        return [f"the cells of {cell:g} m are finer than the pixels of the images, {gsd:.2g} m on the ground"]
    return []


def _view_from_above(
    mesh: TexturedMesh,
    positions: np.ndarray,
    resolution: float,
    pixel_m: float,
    config: SurfaceConfig,
    crs: str,
) -> TopView:
    """The cells within the borders, of samples about as large as the pixels of the depth.

    Raises:
        ConfigError: the resolution is too fine for the scene, or nothing is inside the crop.
    """
    check_cells(positions, resolution, config.crop)
    cells = cells_within(positions, resolution, config.crop)
    most = int(np.sqrt(MOST_SAMPLES / max(cells, 1.0)))
    samples = int(np.clip(round(resolution / pixel_m), 1, max(1, min(most, MOST_PER_SIDE))))
    try:
        return top_view(mesh, positions, resolution, config.crop, samples)
    except DegenerateGeometryError as error:
        (x_low, y_low), (x_high, y_high) = positions[:, :2].min(axis=0), positions[:, :2].max(axis=0)
        what = (
            f"no cell of {resolution:g} m has a surface"
            if config.crop is None
            else "nothing is inside the crop"
        )
        raise ConfigError(
            f"{what}: the surface is from {x_low:.0f}, {y_low:.0f} to {x_high:.0f}, {y_high:.0f} in {crs}"
        ) from error


def _smooth(terrain: Raster) -> Raster:
    """Heights averaged over a few cells, so that contour lines do not show the noise of single cells."""
    known = np.isfinite(terrain.values).astype(np.float32)
    total = cv2.GaussianBlur(np.nan_to_num(terrain.values) * known, (0, 0), SMOOTH_CELLS)
    weight = cv2.GaussianBlur(known, (0, 0), SMOOTH_CELLS)
    with np.errstate(invalid="ignore", divide="ignore"):
        return replace(terrain, values=np.where(known > 0, total / weight, np.float32(np.nan)))


def _rounded(length: float) -> float:
    """The length, rounded up to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= length * (1 - 1e-9)))
