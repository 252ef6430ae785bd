"""Files of the cloud: PLY in coordinates of the model, and LAZ in those of a map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from epipole.dense.fusion import DensePoints
from epipole.io.meshes.cloud_ply import Columns, write_cloud_ply
from epipole.io.survey.coordinate_systems import coordinates_of
from epipole.io.survey.point_clouds import LazChunk, write_laz_chunks
from epipole.pipelines.surfaces.cloud_stage import points_in
from epipole.runs import Unit
from epipole.scene import Georeference

CLOUD_PLY, CLOUD_LAZ = "cloud.ply", "cloud.laz"
SAMPLE = 100_000
"""Points of the cloud in the report, at most about twice as many."""


def write_ply(folder: Path, clouds: Mapping[int, Unit]) -> tuple[int, DensePoints]:
    """Write `cloud.ply`; returns the number of points, and a sample of them."""
    units = list(clouds.values())
    count = sum(len(points) for points in points_in(units))
    step, parts = max(1, count // SAMPLE), list[DensePoints]()

    def columns() -> Iterator[Columns]:
        for points in points_in(units):
            parts.append(points.every(step))
            yield points.points_in_world, points.normals, points.rgb, points.sigma

    write_cloud_ply(folder / CLOUD_PLY, columns(), count)
    return count, DensePoints.joined(parts)


def write_laz(
    folder: Path,
    clouds: Mapping[int, Unit],
    origin: Georeference | None,
    crs: str | None,
    crop: tuple[float, float, float, float] | None = None,
) -> None:
    """Write `cloud.laz`.

    Args:
        folder: the folder.
        clouds: units of the views.
        origin: position of the model on Earth; None: its own coordinates are written.
        crs: coordinate system of the file, if the position is known.
        crop: west, south, east and north border in that coordinate system.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    system = None if origin is None else crs
    write_laz_chunks(folder / CLOUD_LAZ, _chunks(clouds, origin, crs, crop), crs=system)


def _chunks(
    clouds: Mapping[int, Unit],
    origin: Georeference | None,
    crs: str | None,
    crop: tuple[float, float, float, float] | None,
) -> Iterator[LazChunk]:
    west, south, east, north = crop or (-np.inf, -np.inf, np.inf, np.inf)
    for points in points_in(list(clouds.values())):
        if not len(points):
            continue
        xyz = points.points_in_world
        if origin is not None and crs is not None:
            xyz = coordinates_of(origin.lat_lon_alt_of(xyz), crs)
        kept = (xyz[:, 0] >= west) & (xyz[:, 0] <= east) & (xyz[:, 1] >= south) & (xyz[:, 1] <= north)
        yield LazChunk(xyz[kept], points.rgb[kept], points.sigma[kept])
