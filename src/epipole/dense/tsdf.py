"""A surface from depth images: signed distances in a volume (Curless and Levoy 1996), cut at 0 by marching cubes (Lewiner et al. 2003)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64

from epipole import _parallel
from epipole._checks import check_count
from epipole._declared import checked
from epipole.cameras import Camera, CameraModel
from epipole.dense import _tsdf_kernels as kernels
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3
from epipole.scene import Mesh

MOST_SIDE, MOST_VOXELS = 1024, 1 << 28
"""Voxels along the longest side, and of a box: each takes 20 bytes."""
LARGEST = 1e150
"""Coordinate: sums of larger ones are no numbers, and the kernel would take them for pixels."""
BAND = 3.0
"""Voxels before and behind a surface within which distances are told."""
PLANES_TOGETHER = 8


class DistanceVolume:
    """Distances to what depth images show, voxel by voxel; the same for any number of threads.

    Attributes:
        distance: (x, y, z) in shares of the band, above 0 before a surface.
        weight: (x, y, z) images that each voxel is seen in.
    """

    @checked
    def __init__(self, low: Float64[np.ndarray, " 3"], high: Float64[np.ndarray, " 3"], voxels: int) -> None:
        """Begin with nothing seen.

        Args:
            low: (3,) a corner of the box in the world.
            high: (3,) the opposite one.
            voxels: along its longest side.

        Raises:
            DegenerateGeometryError: the box is empty or not finite.
            ConfigError: the number of voxels is not from 2 to 1024, or all are too many.
        """
        if not 2 <= voxels <= MOST_SIDE:
            raise ConfigError(f"voxels must be from 2 to {MOST_SIDE}, got {voxels}")
        if not (low.min() >= -LARGEST and high.max() <= LARGEST and (high - low > 1.0 / LARGEST).all()):
            raise DegenerateGeometryError("the box of the mesh is empty, or too large to be calculated with")
        side = float(np.max(high - low))
        self.low, self.size = low.copy(), side / voxels
        x, y, z = np.maximum(np.ceil((high - low) / self.size - 1e-9), 2).astype(int).tolist()
        check_count(x * y * z, "the voxels of the box", MOST_VOXELS)
        self.distance, self.weight = np.ones((x, y, z), np.float32), np.zeros((x, y, z), np.float32)
        self.colour = np.zeros((x, y, z, 3), np.float32)

    @checked
    def add(
        self,
        camera: Camera,
        cam_from_world: Rigid3,
        depth: Float32[np.ndarray, "h w"],
        coverage: Float32[np.ndarray, "h w"],
        rgb: Float32[np.ndarray, "h w 3"],
    ) -> None:
        """Fuse an image of a pinhole.

        Args:
            camera: without distortion.
            cam_from_world: where it is.
            depth: along the optical axis, times coverage.
            coverage: how much of a pixel is not background.
            rgb: from 0 to 1, times coverage.

        Raises:
            ShapeError: the images are not of the camera's size, or the pose is not a single finite motion.
            ConfigError: the camera has distortion.
        """
        if camera.model not in (CameraModel.PINHOLE, CameraModel.SIMPLE_PINHOLE):
            raise ConfigError("depth is fused from a PINHOLE camera: undistort the images")
        if depth.shape != (camera.height, camera.width):
            raise ShapeError(f"depth is {depth.shape[::-1]}, its camera {camera.width} x {camera.height}")
        if cam_from_world.batch_shape() != () or not (np.abs(cam_from_world.translation) <= LARGEST).all():
            raise ShapeError("cam_from_world must be a single finite motion")
        matrix = camera.K
        intrinsics = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
        view = np.array([*cam_from_world.rotation.ravel(), *cam_from_world.translation, *intrinsics])
        seen = view, depth, coverage, rgb, self.low, self.size, BAND * self.size
        count = len(self.distance)
        _parallel.map_chunks(
            lambda a, b, _: kernels.fuse(*seen, a, b, self.distance, self.weight, self.colour),
            count,
            -(-count // PLANES_TOGETHER),
        )

    def mesh(self) -> Mesh:
        """The surface between what was seen before and behind it.

        Raises:
            DegenerateGeometryError: no surface was seen.
        """
        from skimage.measure import marching_cubes

        seen, message = self.weight > 0, "no surface is seen within the box of the mesh"
        if not (seen & (self.distance < 0)).any():
            raise DegenerateGeometryError(message)
        vertices, faces, _, _ = marching_cubes(self.distance, 0.0, gradient_direction="descent")
        # What is nowhere seen has no distance: a vertex between it and what is seen is none.
        ends = (seen[tuple(end(vertices).astype(np.int64).T)] for end in (np.floor, np.ceil))
        faces = faces[np.logical_and(*ends)[faces].all(axis=1)]
        if not len(faces):
            raise DegenerateGeometryError(message)
        used, faces = np.unique(faces, return_inverse=True)
        vertices, faces = vertices[used], faces.reshape(-1, 3)
        nearest = np.clip(np.rint(vertices).astype(np.int64), 0, np.array(self.distance.shape) - 1)
        rgb = np.rint(255 * np.clip(self.colour[tuple(nearest.T)], 0, 1)).astype(np.uint8)
        return Mesh(self.low + self.size * (vertices + 0.5), faces.astype(np.int64), rgb)
