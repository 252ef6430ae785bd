"""View of a textured mesh from above: height and color of each cell of a grid (a true orthophoto: what is hidden stays hidden)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from epipole._checks import Declared, check_pixels, checked
from epipole.dense.texturing import _raster_kernels as raster
from epipole.dense.texturing.rendering import texture_colors
from epipole.errors import ConfigError, DegenerateGeometryError
from epipole.scene.textured_mesh import TexturedMesh


@dataclass(frozen=True, slots=True, eq=False)
class TopView(Declared):
    """Grid of cells, with rows from north to south."""

    height: Float32[np.ndarray, "h w"]
    """Largest height of the surface at the center of each cell, or the mean of several samples; NaN without a surface."""
    rgb: UInt8[np.ndarray, "h w 3"]
    is_known: Bool[np.ndarray, "h w"]
    x_min: float
    """West border of the first column."""
    y_max: float
    """North border of the first row."""
    resolution: float
    """Side of a cell."""

    def __repr__(self) -> str:
        height, width = self.height.shape
        return f"TopView({width} x {height} cells of {self.resolution:g})"


@checked
def top_view(
    mesh: TexturedMesh,
    positions: Float64[np.ndarray, "n 3"],
    resolution: float,
    crop: tuple[float, float, float, float] | None = None,
    samples: int = 1,
) -> TopView:
    """Look at a mesh from above, in parallel projection.

    Args:
        mesh: the mesh with its texture.
        positions: east, north and height of its vertices; their coordinate system may differ from the mesh's.
        resolution: side of a cell; borders of cells are at its multiples.
        crop: west, south, east and north border: cells whose centers are outside are left out.
        samples: along each side of a cell, whose height and color are the mean: with one, a large cell has those of a point.

    Raises:
        ConfigError: resolution or samples are not positive, or there would be too many cells.
        DegenerateGeometryError: the mesh has no face, or no cell contains a surface.
    """
    if not 0.0 < resolution < np.inf or samples < 1:
        raise ConfigError(f"resolution and samples must be positive, got {resolution} and {samples}")
    if not len(mesh):
        raise DegenerateGeometryError("the mesh has no face")
    used = positions[np.unique(mesh.faces)]
    x_min, y_max, width, height = _grid(used, resolution, crop)
    check_pixels(width * samples, height * samples)
    cells = np.stack([positions[:, 0] - x_min, y_max - positions[:, 1]], axis=1) / resolution * samples - 0.5
    # The kernel interpolates 1/z linearly and shows the largest, so 1/z stands for the height above the lowest vertex plus one.
    lowest = used[:, 2].min()
    above = positions[:, 2] - lowest + 1.0
    shape = height * samples, width * samples
    inverse, nearest = np.zeros(shape, np.float32), np.full(shape, -1, np.int32)
    raster.render_faces(cells, 1.0 / above, mesh.faces, inverse, nearest)
    is_known = nearest >= 0
    if not is_known.any():
        raise DegenerateGeometryError(
            "no cell contains a surface: the resolution is too coarse, or the crop elsewhere"
        )
    rgb = texture_colors(mesh, cells, nearest, None)
    if samples > 1:
        inverse, rgb, is_known = _averaged(inverse, rgb, is_known, samples)
    heights = np.where(is_known, inverse.astype(np.float64) - 1.0 + lowest, np.nan).astype(np.float32)
    return TopView(heights, rgb, is_known, float(x_min), float(y_max), float(resolution))


def _grid(
    positions: np.ndarray, resolution: float, crop: tuple[float, float, float, float] | None
) -> tuple[float, float, int, int]:
    """West and north border, and numbers of columns and rows, of the cells around positions."""
    (x_low, y_low), (x_high, y_high) = positions[:, :2].min(axis=0), positions[:, :2].max(axis=0)
    first, last = np.floor(x_low / resolution), np.ceil(x_high / resolution)
    bottom, top = np.floor(y_low / resolution), np.ceil(y_high / resolution)
    if crop is not None:
        west, south, east, north = (border / resolution for border in crop)
        first, last = max(first, np.ceil(west - 0.5)), min(last, np.floor(east + 0.5))
        bottom, top = max(bottom, np.ceil(south - 0.5)), min(top, np.floor(north + 0.5))
    width, height = max(1, int(last - first)), max(1, int(top - bottom))
    return float(first * resolution), float(top * resolution), width, height


def _averaged(
    inverse: np.ndarray, rgb: np.ndarray, is_known: np.ndarray, samples: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means over the known samples of each cell, of which at least half must be known."""

    def sums(values: np.ndarray) -> np.ndarray:
        height, width = (side // samples for side in values.shape[:2])
        blocks = values.reshape(height, samples, width, samples, *values.shape[2:])
        return np.asarray(blocks.sum(axis=(1, 3), dtype=np.float32))

    count = sums(is_known)
    total = np.maximum(count, 1.0)
    colors = np.rint(sums(rgb * is_known[..., None]) / total[..., None]).astype(np.uint8)
    kept = 2.0 * count >= samples**2
    return sums(inverse * is_known) / total, np.where(kept[..., None], colors, np.uint8(0)), kept
