"""Surface reconstruction from depth images: TSDF (Curless and Levoy 1996) and marching cubes (Lewiner et al. 2003)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64

from epipole import _parallel
from epipole._checks import check_count, checked
from epipole.cameras import Camera, CameraModel
from epipole.dense import _tsdf_kernels as kernels
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3
from epipole.scene import Mesh

MOST_SIDE = 1024  # voxels along the longest side
MOST_VOXELS = 1 << 28  # voxels of a volume, 20 bytes each
LARGEST = 1e150
"""Largest coordinate: sums of larger ones overflow, and the kernel would use them as pixels."""
BAND = 3.0
"""Truncation distance in front of and behind a surface, in voxels."""
PLANES_TOGETHER = 8


class DistanceVolume:
    """Truncated signed distances to the surfaces of depth images; independent of the number of threads.

    Attributes:
        distance: (x, y, z) in units of the band, positive in front of a surface.
        weight: (x, y, z) number of images that see each voxel.
    """

    @checked
    def __init__(self, low: Float64[np.ndarray, " 3"], high: Float64[np.ndarray, " 3"], voxels: int) -> None:
        """Create an empty volume.

        Args:
            low: (3,) minimum corner of the box in the world.
            high: (3,) maximum corner.
            voxels: number along the longest side.

        Raises:
            DegenerateGeometryError: the box is empty or not finite.
            ConfigError: voxels is not from 2 to 1024, or the volume has too many voxels.
        """
        if not 2 <= voxels <= MOST_SIDE:
            raise ConfigError(f"voxels must be from 2 to {MOST_SIDE}, got {voxels}")
        if not (low.min() >= -LARGEST and high.max() <= LARGEST and (high - low > 1.0 / LARGEST).all()):
            raise DegenerateGeometryError("the box of the mesh is empty or too large")
        side = float(np.max(high - low))
        self.low, self.size = low.copy(), side / voxels
        x, y, z = np.maximum(np.ceil((high - low) / self.size - 1e-9), 2).astype(int).tolist()
        check_count(x * y * z, "the voxels of the box", MOST_VOXELS)
        self.distance, self.weight = np.ones((x, y, z), np.float32), np.zeros((x, y, z), np.float32)
        self.color = np.zeros((x, y, z, 3), np.float32)

    @checked
    def add(
        self,
        camera: Camera,
        cam_from_world: Rigid3,
        depth: Float32[np.ndarray, "h w"],
        coverage: Float32[np.ndarray, "h w"],
        rgb: Float32[np.ndarray, "h w 3"],
    ) -> None:
        """Integrate a depth image of a pinhole camera.

        Args:
            camera: intrinsics without distortion.
            cam_from_world: pose of the camera.
            depth: along the optical axis, times coverage.
            coverage: opacity of each pixel.
            rgb: from 0 to 1, times coverage.

        Raises:
            ShapeError: depth does not have the camera's size, or the pose is not a single finite motion.
            ConfigError: the camera has distortion.
        """
        if camera.model not in (CameraModel.PINHOLE, CameraModel.SIMPLE_PINHOLE):
            raise ConfigError("camera must be PINHOLE or SIMPLE_PINHOLE: undistort the images")
        if depth.shape != (camera.height, camera.width):
            raise ShapeError(
                f"depth has size {depth.shape[::-1]}, but its camera {camera.width} x {camera.height}"
            )
        if cam_from_world.batch_shape() != () or not (np.abs(cam_from_world.translation) <= LARGEST).all():
            raise ShapeError("cam_from_world must be a single finite motion")
        matrix = camera.K
        intrinsics = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
        view = np.array([*cam_from_world.rotation.ravel(), *cam_from_world.translation, *intrinsics])
        seen = view, depth, coverage, rgb, self.low, self.size, BAND * self.size
        count = len(self.distance)
        _parallel.map_chunks(
            lambda a, b, _: kernels.fuse(*seen, a, b, self.distance, self.weight, self.color),
            count,
            -(-count // PLANES_TOGETHER),
        )

    def mesh(self) -> Mesh:
        """Extract the surface as a mesh.

        Raises:
            DegenerateGeometryError: no surface was seen.
        """
        from skimage.measure import marching_cubes

        seen, message = self.weight > 0, "no surface was seen within the box of the mesh"
        if not (seen & (self.distance < 0)).any():
            raise DegenerateGeometryError(message)
        vertices, faces, _, _ = marching_cubes(self.distance, 0.0, gradient_direction="descent")
        # Unseen voxels have no distance: drop vertices between them and seen ones.
        ends = (seen[tuple(end(vertices).astype(np.int64).T)] for end in (np.floor, np.ceil))
        faces = faces[np.logical_and(*ends)[faces].all(axis=1)]
        if not len(faces):
            raise DegenerateGeometryError(message)
        used, faces = np.unique(faces, return_inverse=True)
        vertices, faces = vertices[used], faces.reshape(-1, 3)
        nearest = np.clip(np.rint(vertices).astype(np.int64), 0, np.array(self.distance.shape) - 1)
        rgb = np.rint(255 * np.clip(self.color[tuple(nearest.T)], 0, 1)).astype(np.uint8)
        return Mesh(self.low + self.size * (vertices + 0.5), faces.astype(np.int64), rgb)
