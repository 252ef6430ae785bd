"""Grid of densities and colors, rendered by ray marching (Sun et al., DVGO; Fridovich-Keil et al., Plenoxels; 2022)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32
from scipy import ndimage

from epipole import _parallel
from epipole._checks import checked
from epipole._checks.tables import Expected, require_arrays
from epipole.cameras import Camera
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.fields.nerf import _voxel_kernels as kernels
from epipole.fields.nerf._march_kernels import BLOCK
from epipole.fields.nerf._voxel_kernels import MOST_SAMPLES
from epipole.fields.rays import blocks_of, rays_of_camera
from epipole.fields.splat._simd_kernels import ROW
from epipole.geometry import Rigid3
from epipole.scene.gaussian_cloud import GaussianCloud
from epipole.scene.local_origin import local_origin

TOGETHER = 2048
"""Rays processed as one task."""
LEAST_ALPHA = 0.1
"""Smallest alpha of a corner that becomes a Gaussian."""
FOG = 0.02
"""Lower limit of that alpha if the whole grid is thin."""
HALF_WIDTH = 0.5
"""Standard deviation of these Gaussians, in voxels."""
SURFACE = 3
"""Depth of the surface layer that becomes Gaussians, in voxels."""


class Voxels(NamedTuple):
    """A grid, as the kernels read it; world point p is at (p - low) / size."""

    row_of: np.ndarray
    """(x, y, z) int32 row of each corner, -1 for none; rows are in the order of corners."""
    occupied: np.ndarray
    """(x - 1, y - 1, z - 1) whether a cell may be non-empty."""
    seen: np.ndarray
    """(x - 1, y - 1, z - 1) whether training has seen something in a cell."""
    blocks: np.ndarray
    """Whether each block of 8 x 8 x 8 cells has an occupied cell."""
    values: np.ndarray
    """(rows, 16) density, then harmonics of degree 0 and 1 of red, green and blue: 1 + 3 basis + channel."""
    low: np.ndarray
    size: float
    delta: np.float32
    """Step length, in the unit of the densities, which is the voxel size of the first grid."""


class MarchWork(NamedTuple):
    """Scratch of a thread for one ray."""

    acc: np.ndarray
    light: np.ndarray
    position: np.ndarray
    origin: np.ndarray
    direction: np.ndarray
    by: np.ndarray
    wanted: np.ndarray


_VOXELS = {
    "row_of": Expected("int32", "x+1 y+1 z+1", least=-1, below="n"),
    "occupied": Expected("uint8", "x y z", most=1),
    "seen": Expected("uint8", "x y z", most=1),
    "blocks": Expected("uint8", "_ _ _", most=1),
    "values": Expected("float32", f"n {ROW}"),
    "low": Expected("float64", "3"),
    "size": Expected("float64"),
    "delta": Expected("float32"),
}


def check_voxels(voxels: Voxels) -> None:
    """Check an explicit grid.

    Raises:
        ShapeError: an array has the wrong type or shape.
    """
    require_arrays(voxels._asdict(), _VOXELS)
    check_room(voxels.occupied.shape, voxels.blocks.shape, min(voxels.size, float(voxels.delta)))


def check_room(cells: tuple[int, ...], blocks: tuple[int, ...], size: float) -> None:
    """Check the blocks and the size of cells.

    Raises:
        ShapeError: blocks and cells do not match, or the size is not positive.
    """
    if min(cells) < 1 or blocks != tuple(-(-side // BLOCK) for side in cells):
        raise ShapeError(f"blocks must have {BLOCK} cells per side of the cells {cells}, got {blocks}")
    if not size > 0:
        raise ShapeError(f"size must be positive, got {size}")


def march_work() -> MarchWork:
    """Scratch of a thread."""
    shapes = (ROW, (MOST_SAMPLES, 6), (MOST_SAMPLES, 6), 3, 3, 3, 3)
    return MarchWork(*(np.zeros(shape, np.float32) for shape in shapes))


def corners_of(cells: np.ndarray) -> np.ndarray:
    """Corners of the given cells."""
    x, y, z = cells.shape
    out = np.zeros((x + 1, y + 1, z + 1), bool)
    for i, j, k in np.ndindex(2, 2, 2):
        out[i : i + x, j : j + y, k : k + z] |= cells
    return out


def voxels_on(
    cells: np.ndarray, low: np.ndarray, size: float, unit: float, values: np.ndarray | None = None
) -> Voxels:
    """A grid with the given occupied cells (x, y, z), whose corners are initialized with `values`, else with zeros."""
    corners = corners_of(cells)
    index = np.full(corners.shape, -1, np.int32)
    rows = int(corners.sum())
    index[corners] = np.arange(rows, dtype=np.int32)
    own = np.zeros((rows, ROW), np.float32)
    if values is not None:
        own[:, : values.shape[1]] = values
    delta = np.float32(kernels.STEP * size / unit)
    seen = np.zeros(cells.shape, np.uint8)
    marks = cells.astype(np.uint8), seen, blocks_of(cells)
    return Voxels(index, *marks, own, low.astype(np.float64), size, delta)


def unit_of(voxels: Voxels) -> float:
    """Length unit of the densities."""
    return float(kernels.STEP * voxels.size / voxels.delta)


@checked
def render_voxels(
    voxels: Voxels, camera: Camera, cam_from_world: Rigid3, background: Float32[np.ndarray, " 3"]
) -> tuple[np.ndarray, np.ndarray, int]:
    """Image (h, w, 3), depth (h, w) along rays times coverage in world units, and the number of samples.

    Raises:
        ShapeError: the arrays of the grid do not match, or the pose is not a single pose.
        ConfigError: the camera has too many pixels to render.
    """
    check_voxels(voxels)
    rays, count = rays_of_camera(camera, cam_from_world), camera.width * camera.height
    image, depth = np.empty((count, 3), np.float32), np.empty(count, np.float32)
    samples = _parallel.map_chunks(
        lambda a, b, _: kernels.render_pixels(
            rays,
            0,
            camera.width,
            voxels,
            background,
            a,
            b,
            image,
            depth,
            march_work(),
        ),
        count,
        -(-count // TOGETHER),
    )
    shape = camera.height, camera.width
    return image.reshape(*shape, 3), depth.reshape(shape) * np.float32(voxels.size), sum(samples)


@checked
def gaussians_of(voxels: Voxels, most: int) -> GaussianCloud:
    """Round Gaussians at corners near the surface: those that are opaque enough, with a more transparent corner nearby.

    Raises:
        DegenerateGeometryError: the whole grid is transparent.
        ShapeError: the arrays of the grid do not match.
        ConfigError: `most` is not positive.
    """
    check_voxels(voxels)
    if most < 1:
        raise ConfigError(f"most must be positive, got {most}")
    raw = voxels.values[:, 0].astype(np.float64) + float(kernels.SHIFT)
    own = 1.0 - np.exp(-np.logaddexp(0.0, raw) * float(voxels.delta / kernels.STEP))
    alpha = np.zeros(voxels.row_of.shape, np.float32)
    alpha[voxels.row_of >= 0] = own
    least_beside = ndimage.minimum_filter(alpha, size=2 * SURFACE + 1)
    least = min(LEAST_ALPHA, max(0.5 * float(alpha.max()), FOG))
    corners = np.argwhere((alpha > least) & (least_beside <= least))
    if not len(corners):
        raise DegenerateGeometryError("the grid is empty: all of it is transparent")
    thinned = max(1.0, len(corners) / most)
    corners = corners[np.linspace(0, len(corners) - 1, min(most, len(corners))).astype(np.int64)]
    rows, n = voxels.row_of[tuple(corners.T)], len(corners)
    opacity = np.clip(own[rows], least, 0.99)
    deviation = HALF_WIDTH * voxels.size * np.sqrt(thinned)
    positions = voxels.low + voxels.size * corners
    origin = local_origin(positions)
    return GaussianCloud(
        (positions - origin).astype(np.float32),
        np.full((n, 3), np.log(deviation), np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        np.log(opacity / (1.0 - opacity)).astype(np.float32),
        np.ascontiguousarray(voxels.values[rows, 1:13].reshape(n, 4, 3)),
        origin,
    )
