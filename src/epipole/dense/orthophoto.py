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
    """Largest height of the surface at the center of each cell; NaN without a surface."""
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
def top_view(mesh: TexturedMesh, positions: Float64[np.ndarray, "n 3"], resolution: float) -> TopView:
    """Look at a mesh from above, in parallel projection.

    Args:
        mesh: the mesh with its texture.
        positions: east, north and height of its vertices; their coordinate system may differ from the mesh's.
        resolution: side of a cell; borders of cells are at its multiples.

    Raises:
        ConfigError: resolution is not positive, or there would be too many cells.
        DegenerateGeometryError: the mesh has no face.
    """
    if not 0.0 < resolution < np.inf:
        raise ConfigError(f"resolution must be positive, got {resolution}")
    if not len(mesh):
        raise DegenerateGeometryError("the mesh has no face")
    used = positions[np.unique(mesh.faces)]
    (x_low, y_low, lowest), (x_high, y_high, _) = used.min(axis=0), used.max(axis=0)
    x_min, y_max = np.floor(x_low / resolution) * resolution, np.ceil(y_high / resolution) * resolution
    width, height = (max(1, int(np.ceil(span / resolution))) for span in (x_high - x_min, y_max - y_low))
    check_pixels(width, height)
    cells = np.stack([positions[:, 0] - x_min, y_max - positions[:, 1]], axis=1) / resolution - 0.5
    # The kernel interpolates 1/z linearly and shows the largest, so 1/z stands for the height above the lowest vertex plus one.
    above = positions[:, 2] - lowest + 1.0
    inverse, nearest = np.zeros((height, width), np.float32), np.full((height, width), -1, np.int32)
    raster.render_faces(cells, 1.0 / above, mesh.faces, inverse, nearest)
    is_known = nearest >= 0
    if not is_known.any():
        raise DegenerateGeometryError("no cell contains a surface: the resolution is too coarse")
    rgb = texture_colors(mesh, cells, nearest, None)
    heights = np.where(is_known, inverse.astype(np.float64) - 1.0 + lowest, np.nan).astype(np.float32)
    return TopView(heights, rgb, is_known, float(x_min), float(y_max), float(resolution))
