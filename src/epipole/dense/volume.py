"""Surface of many depth images: a sparse volume of truncated signed distances, and its mesh by surface nets.

Distances are integrated as by Curless and Levoy (SIGGRAPH 1996), weighted by the inverse variance of each depth, into blocks of voxels
along the surfaces only (Niessner et al., SIGGRAPH Asia 2013). The mesh has a vertex for each cell that the surface crosses
(surface nets; Gibson, MICCAI 1998).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64

from epipole import _parallel
from epipole._checks import checked
from epipole.cameras import Camera, CameraModel
from epipole.dense import _volume_kernels as kernels
from epipole.dense.view import intrinsics_of
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3
from epipole.scene import Mesh
from epipole.scene.view_depth import ViewDepth

BAND = 4.0
"""Truncation distance in front of and behind a surface, in voxels."""
STRIDE_PX = 2
"""Pixels between those that allocate blocks: a block is wider."""
LEAST_WEIGHT = 0.5
"""Smallest weight of a voxel, in depths without error."""
MOST_BLOCKS = 1 << 18
"""Blocks of 512 voxels, 6 kB each while the mesh is extracted."""
_BLOCKS, _ROWS = 64, 64


class SparseVolume:
    """Truncated signed distances in blocks along surfaces; independent of the number of threads."""

    @checked
    def __init__(self, blocks: Int64[np.ndarray, "b 3"], voxel: float) -> None:
        """Create an empty volume.

        Args:
            blocks: distinct coordinates of blocks, from `blocks_of_depth`.
            voxel: side of a voxel.

        Raises:
            ConfigError: voxel is not positive, or there are too many blocks.
        """
        if not 0.0 < voxel < np.inf:
            raise ConfigError(f"voxel must be positive, got {voxel}")
        if len(blocks) > MOST_BLOCKS:
            raise ConfigError(
                f"the surface needs {len(blocks):,} blocks, more than {MOST_BLOCKS:,}: use larger voxels"
            )
        self.blocks, self.voxel = blocks, voxel
        shape = (len(blocks), *[kernels.SIDE] * 3)
        self.distance, self.weight = np.ones(shape, np.float32), np.zeros(shape, np.float32)

    @checked
    def add(self, camera: Camera, cam_from_world: Rigid3, depth: ViewDepth) -> None:
        """Integrate the depth of a pinhole camera; where it is infinite, the space in front of the camera is free.

        Raises:
            ShapeError: depth does not have the camera's size, or the pose is not a single finite one.
            ConfigError: the camera has distortion.
        """
        _check_view(camera, cam_from_world, depth)
        view = cam_from_world.rotation.ravel(), cam_from_world.translation, intrinsics_of(camera)
        given = depth.depth, depth.sigma, view, self.blocks, self.voxel, BAND * self.voxel
        _parallel.map_chunks(
            lambda a, b, _: kernels.integrate(*given, a, b, self.distance, self.weight),
            len(self.blocks),
            -(-len(self.blocks) // _BLOCKS),
        )

    def mesh(self) -> Mesh:
        """Extract the surface; vertices are gray.

        Raises:
            DegenerateGeometryError: there is no surface.
        """
        ahead, behind = neighbors_of(self.blocks, 1), neighbors_of(self.blocks, -1)
        index = np.full(self.distance.shape, -1, np.int32)
        chunks = -(-len(self.blocks) // _BLOCKS)
        parts = _parallel.map_chunks(
            lambda a, b, _: self._vertices(ahead, index, a, b), len(self.blocks), chunks
        )
        first = 0
        for (a, b), part in zip(_parallel.chunk_bounds(len(self.blocks), chunks), parts):
            own = index[a:b]
            own[own >= 0] += first
            first += len(part)
        faces = _parallel.map_chunks(
            lambda a, b, _: self._faces(ahead, behind, index, a, b), len(self.blocks), chunks
        )
        corners = np.concatenate([np.empty((0, 3), np.int64), *faces])
        if not len(corners):
            raise DegenerateGeometryError("no surface was seen well enough")
        used, corners = np.unique(corners, return_inverse=True)
        vertices = self.voxel * np.concatenate(parts)[used]
        return Mesh(vertices, corners.reshape(-1, 3).astype(np.int64), np.full((len(used), 3), 160, np.uint8))

    def _vertices(self, ahead: np.ndarray, index: np.ndarray, start: int, stop: int) -> np.ndarray:
        out = np.empty(((stop - start) * kernels.SIDE**3, 3))
        given = self.blocks, ahead, self.distance, self.weight, LEAST_WEIGHT, np.empty(8, np.float32)
        number = kernels.net_vertices(*given, start, stop, out, index)
        return out[:number].copy()

    def _faces(
        self, ahead: np.ndarray, behind: np.ndarray, index: np.ndarray, start: int, stop: int
    ) -> np.ndarray:
        out = np.empty(((stop - start) * 6 * kernels.SIDE**3, 3), np.int64)
        number = kernels.net_faces(
            ahead, behind, self.distance, index, np.empty(4, np.int64), start, stop, out
        )
        return out[:number].copy()


@checked
def blocks_of_depth(
    camera: Camera, cam_from_world: Rigid3, depth: ViewDepth, voxel: float
) -> Int64[np.ndarray, " n"]:
    """Sorted keys of the blocks within the band of a view's depth; `blocks_of_keys` gives their coordinates.

    Raises:
        ShapeError: depth does not have the camera's size, or the pose is not a single finite one.
        ConfigError: the scene is too large for the voxels, or the camera has distortion.
    """
    _check_view(camera, cam_from_world, depth)
    world_from_cam = cam_from_world.inverse()
    view = world_from_cam.rotation.ravel(), world_from_cam.translation, intrinsics_of(camera)
    side = kernels.SIDE * voxel
    farthest = (
        float(depth.depth.max(initial=0.0, where=np.isfinite(depth.depth))) * 4.0 + np.abs(view[1]).max()
    )
    if not farthest < 0.5 * kernels.OFFSET * side:
        raise ConfigError("the scene is too large for the voxels: use larger voxels")

    def touched(start: int, stop: int, _: int) -> np.ndarray:
        keys = np.empty(
            5 * (-(-(stop - start) // STRIDE_PX)) * (-(-depth.depth.shape[1] // STRIDE_PX)), np.int64
        )
        number = kernels.touched_blocks(depth.depth, view, side, BAND * voxel, STRIDE_PX, start, stop, keys)
        return np.unique(keys[:number])

    height = len(depth.depth)
    return np.unique(np.concatenate(_parallel.map_chunks(touched, height, -(-height // _ROWS))))


@checked
def blocks_of_keys(keys: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, "n 3"]:
    """Coordinates of blocks; in world units, a block starts at its coordinates times 8 voxels."""
    mask = (1 << 21) - 1
    return np.stack([keys >> 42, (keys >> 21) & mask, keys & mask], axis=1) - kernels.OFFSET


@checked
def keys_within(
    keys: Int64[np.ndarray, " n"],
    voxel: float,
    low: Float64[np.ndarray, " 3"],
    high: Float64[np.ndarray, " 3"],
) -> Int64[np.ndarray, " m"]:
    """Keys of the blocks that overlap a box, whose corners are in world units."""
    blocks, side = blocks_of_keys(keys), kernels.SIDE * voxel
    return keys[(((blocks + 1) * side > low) & (blocks * side < high)).all(axis=1)]


@checked
def neighbors_of(blocks: Int64[np.ndarray, "b 3"], step: int) -> Int64[np.ndarray, "b 8"]:
    """Rows of the blocks at offsets 0 and `step` along each axis, 4 x + 2 y + z; -1 where there is none."""
    keys = _keys(blocks)
    order = np.argsort(keys)
    out = np.empty((len(blocks), 8), np.int64)
    for n in range(8):
        wanted = _keys(blocks + step * np.array([n >> 2, (n >> 1) & 1, n & 1]))
        at = np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)
        found = order[at]
        out[:, n] = np.where(keys[found] == wanted, found, -1)
    return out


def _check_view(camera: Camera, cam_from_world: Rigid3, depth: ViewDepth) -> None:
    if camera.model not in (CameraModel.PINHOLE, CameraModel.SIMPLE_PINHOLE):
        raise ConfigError("the camera must be PINHOLE or SIMPLE_PINHOLE: undistort the images")
    if depth.depth.shape != (camera.height, camera.width):
        raise ShapeError("depth and camera have different sizes")
    if cam_from_world.batch_shape() != () or not np.isfinite(cam_from_world.as_matrix()).all():
        raise ShapeError("cam_from_world must be a single finite pose")


def _keys(blocks: np.ndarray) -> np.ndarray:
    x, y, z = (blocks + kernels.OFFSET).T
    return np.asarray((x << 42) | (y << 21) | z)
