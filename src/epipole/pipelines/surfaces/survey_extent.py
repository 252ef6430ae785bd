"""Checks of the options of survey products against the extent of the model, before depth is computed."""

from __future__ import annotations

import numpy as np

from epipole._checks import MOST_PIXELS
from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.io.survey.contours import check_interval
from epipole.io.survey.coordinate_systems import coordinates_of
from epipole.pipelines.surfaces.config import SurfaceConfig
from epipole.pipelines.surfaces.inputs import SurfaceInputs
from epipole.pipelines.surfaces.view_files import ViewFile
from epipole.scene import Georeference

BORDER = 0.01
"""Quantile of the points' coordinates that is named as the border of the model: single points may be wrong."""
MOST_CELLS = 0.9 * MOST_PIXELS
"""Cells of a raster; the grid has some more at its borders."""
GROUND = 0.05
"""Quantiles of the points' heights between which contour lines are counted."""


def check_extent(inputs: SurfaceInputs, origin: Georeference, crs: str, config: SurfaceConfig) -> None:
    """Check that some image shows the crop, and that cells and contour lines are not too many for the model's points.

    Raises:
        ConfigError: they are not.
    """
    points = inputs.model.points.xyz_in_world
    positions = coordinates_of(origin.lat_lon_alt_of(points[np.isfinite(points).all(axis=1)]), crs)
    if config.crop is not None:
        _check_crop(inputs, origin, crs, config.crop, positions)
    if config.resolution_m is not None and len(positions):
        low, high = np.quantile(positions, [BORDER, 1.0 - BORDER], axis=0)
        check_cells(np.stack([low, high]), config.resolution_m, config.crop)
    if config.contour_m is not None:
        lowest, highest = np.quantile(positions[:, 2], [GROUND, 1.0 - GROUND])
        check_interval(config.contour_m, float(lowest), float(highest))


def cells_within(
    positions: np.ndarray, resolution: float, crop: tuple[float, float, float, float] | None
) -> float:
    """Number of cells of the rectangle around positions (n, 3), within the crop."""
    low, high = positions[:, :2].min(axis=0), positions[:, :2].max(axis=0)
    if crop is not None:
        low, high = np.maximum(low, crop[:2]), np.minimum(high, crop[2:])
    return float(np.prod(np.maximum(high - low, 0.0) / resolution))


def check_cells(
    positions: np.ndarray, resolution: float, crop: tuple[float, float, float, float] | None
) -> None:
    """Check that the cells of the rectangle around positions (n, 3) are not too many.

    Raises:
        ConfigError: they are.
    """
    cells = cells_within(positions, resolution, crop)
    if cells > MOST_CELLS:
        raise ConfigError(
            f"{cells:.3g} cells of {resolution:g} m are more than {MOST_CELLS:.3g}: pass a coarser --resolution-m, or parts of the area"
            " (--crop) one after another"
        )


def _check_crop(
    inputs: SurfaceInputs,
    origin: Georeference,
    crs: str,
    crop: tuple[float, float, float, float],
    positions: np.ndarray,
) -> None:
    """Compare the crop with the rectangle around each view's frustum within its range of depth, which is larger than its part of the surface."""
    west, south, east, north = crop
    for k in inputs.usable:
        corners = _frustum(inputs.views[k], inputs.depths[k])
        x, y, _ = coordinates_of(origin.lat_lon_alt_of(corners), crs).T
        if not (x.max() < west or x.min() > east or y.max() < south or y.min() > north):
            return
    (x_low, y_low), (x_high, y_high) = np.quantile(positions[:, :2], [BORDER, 1.0 - BORDER], axis=0)
    raise ConfigError(
        f"no image shows the crop {west:g}, {south:g}, {east:g}, {north:g}: the points of the model are from {x_low:.0f}, {y_low:.0f}"
        f" to {x_high:.0f}, {y_high:.0f} in {crs}"
    )


def _frustum(view: ViewFile, depths: tuple[float, float]) -> np.ndarray:
    """(8, 3) corners of what a view sees between two depths."""
    width, height = view.pinhole.width, view.pinhole.height
    pixels = np.array([[x, y] for x in (-0.5, width - 0.5) for y in (-0.5, height - 0.5)])
    rays = view.pinhole.unproject(pixels)
    in_cam = (rays / rays[:, 2:])[None] * np.array(depths)[:, None, None]
    world_from_cam: Rigid3 = view.cam_from_world.inverse()
    return world_from_cam.apply(in_cam.reshape(-1, 3))
