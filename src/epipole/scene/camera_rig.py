"""Two or more rigidly mounted cameras, whose images are stacked in one image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from epipole._checks import check_fields, checked
from epipole.cameras import MAX_PARAMS, Camera
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3

MOST_CAMERAS = 6
OVERLAP_DEPTHS = (5.0, 10.0, 20.0, 40.0)
"""Depths, in multiples of the largest distance between two cameras, at which common views are searched."""
GRID = 12
LEAST_COMMON = 0.05
"""Fraction of the pixels of one camera that another one must see, too, to measure depth from a single instant."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraRig:
    """Rigidly mounted cameras of any models.

    All pixels refer to the stacked image: the cameras' images below each other, the first on top, aligned on the left. The frame of
    the rig is usually that of the first camera.
    """

    cameras: tuple[Camera, ...]
    cam_from_rig: Rigid3
    """Batch shape (k,); its unit of length is that of all results, usually the meter."""

    def __post_init__(self) -> None:
        """Check the number of cameras and their poses.

        Raises:
            ShapeError: there is not one pose per camera.
            ConfigError: there are fewer than two cameras or too many, or they are all at one position.
        """
        check_fields(self)
        count = len(self.cameras)
        if not 2 <= count <= MOST_CAMERAS:
            raise ConfigError(f"a rig has 2 to {MOST_CAMERAS} cameras, got {count}")
        if self.cam_from_rig.batch_shape() != (count,):
            shape = self.cam_from_rig.batch_shape()
            raise ShapeError(f"cam_from_rig must have one motion per camera ({count},), got {shape}")
        if not np.isfinite(self.cam_from_rig.translation).all():
            raise ConfigError("cam_from_rig must be finite")
        if self.length == 0:
            raise ConfigError(
                "all cameras of the rig are at the same position, so that it measures no distance"
            )

    @property
    def centers_in_rig(self) -> Float64[np.ndarray, "k 3"]:
        """Camera centers."""
        return self.cam_from_rig.inverse().translation

    @property
    def length(self) -> float:
        """Largest distance between two camera centers."""
        centers = self.centers_in_rig
        return float(np.linalg.norm(centers[:, None] - centers[None], axis=2).max())

    @property
    def width(self) -> int:
        """Of the stacked image."""
        return max(camera.width for camera in self.cameras)

    @property
    def height(self) -> int:
        """Of the stacked image."""
        return sum(camera.height for camera in self.cameras)

    @property
    def tops(self) -> Int64[np.ndarray, " k1"]:
        """First row of each camera in the stacked image, and the row after the last."""
        return _tops(self)

    @property
    def focal_px(self) -> float:
        """Median focal length of the cameras."""
        return float(np.median([camera.focal_px for camera in self.cameras]))

    def padded_params(self) -> Float64[np.ndarray, "k 12"]:
        """Parameters of each camera for pixels of the stacked image, padded with zeros."""
        out = np.zeros((len(self.cameras), MAX_PARAMS))
        for k, (camera, top) in enumerate(zip(self.cameras, self.tops)):
            out[k] = camera.padded_params()
            out[k, camera.model.principal_point_indices[1]] += top
        return out

    @checked
    def camera_of(self, pixels: Float64[np.ndarray, "n 2"]) -> Int64[np.ndarray, " n"]:
        """The camera to which each pixel belongs."""
        return np.clip(
            np.searchsorted(self.tops - 0.5, pixels[:, 1], side="right") - 1, 0, len(self.cameras) - 1
        )

    @checked
    def project(
        self, points_in_rig: Float64[np.ndarray, "n 3"], camera: Int64[np.ndarray, " n"]
    ) -> Float64[np.ndarray, "n 2"]:
        """Pixels of points in the given cameras, also beyond their edges; NaN where a camera cannot see the point."""
        out = np.full((len(points_in_rig), 2), np.nan)
        for k in np.unique(camera):
            rows = camera == k
            out[rows] = self.cameras[k].project(self.cam_from_rig[k].apply(points_in_rig[rows]))
            out[rows, 1] += self.tops[k]
        return out

    @checked
    def sees(
        self,
        pixels: Float64[np.ndarray, "n 2"],
        camera: Int64[np.ndarray, " n"],
        margin_px: float = 0.0,
    ) -> Bool[np.ndarray, " n"]:
        """Whether projected pixels are inside the image of their camera, at least `margin_px` from its edges.

        Raises:
            ConfigError: a camera does not exist.
        """
        if len(camera) and not 0 <= camera.min() <= camera.max() < len(self.cameras):
            raise ConfigError(f"camera must be from 0 to {len(self.cameras) - 1}")
        size = np.array([(c.width, c.height) for c in self.cameras], float)[camera]
        local = pixels - np.column_stack([np.zeros(len(pixels)), self.tops[camera]])
        return ((local >= margin_px) & (local < size - margin_px)).all(axis=1)

    @checked
    def unproject(
        self, pixels: Float64[np.ndarray, "n 2"], camera: Int64[np.ndarray, " n"]
    ) -> Float64[np.ndarray, "n 3"]:
        """Unit directions, in the coordinates of each pixel's camera; NaN where the distortion has no inverse."""
        out = np.full((len(pixels), 3), np.nan)
        for k in np.unique(camera):
            rows = camera == k
            out[rows] = self.cameras[k].unproject(pixels[rows] - [0.0, float(self.tops[k])])
        return out

    def stack(self, images: Sequence[np.ndarray]) -> UInt8[np.ndarray, "h2 w2"]:
        """The stacked image of gray images (8 bits), one per camera.

        Raises:
            ShapeError: there is not one image per camera, or one does not have its camera's size.
        """
        if len(images) != len(self.cameras):
            raise ShapeError(f"a rig of {len(self.cameras)} cameras needs as many images, got {len(images)}")
        out = np.zeros((self.height, self.width), np.uint8)
        for k, (image, camera, top) in enumerate(zip(images, self.cameras, self.tops)):
            if image.shape != (camera.height, camera.width):
                size = (
                    f"{image.shape[1]} x {image.shape[0]}" if image.ndim == 2 else f"of shape {image.shape}"
                )
                raise ShapeError(
                    f"the image of camera {k} is {size}, but the camera is {camera.width} x {camera.height}"
                )
            out[top : top + camera.height, : camera.width] = image
        return out

    def parts(self, stacked: np.ndarray) -> list[np.ndarray]:
        """The images of the cameras, as views of the stacked image."""
        return [
            stacked[top : top + camera.height, : camera.width] for camera, top in zip(self.cameras, self.tops)
        ]

    def common_views(self) -> Float64[np.ndarray, "k k"]:
        """Fraction of the pixels of each camera (row) that each other camera (column) sees at some usual depth."""
        return _common_views(self)

    @property
    def measures_depth(self) -> bool:
        """Whether two cameras at different positions have a common view."""
        return _measures_depth(self)

    def __repr__(self) -> str:
        return f"CameraRig({len(self.cameras)} cameras, {self.length:.4g} long)"


# Properties of the last rigs are kept, since every frame needs them.


@lru_cache(maxsize=8)
def _tops(rig: CameraRig) -> np.ndarray:
    return _unwritable(np.cumsum([0, *(camera.height for camera in rig.cameras)]))


@lru_cache(maxsize=8)
def _measures_depth(rig: CameraRig) -> bool:
    apart = np.linalg.norm(rig.centers_in_rig[:, None] - rig.centers_in_rig[None], axis=2)
    return bool((rig.common_views()[apart > 0] >= LEAST_COMMON).any())


@lru_cache(maxsize=8)
def _common_views(rig: CameraRig) -> np.ndarray:
    count = len(rig.cameras)
    out = np.zeros((count, count))
    rig_from_cam = rig.cam_from_rig.inverse()
    for k, camera in enumerate(rig.cameras):
        u, v = np.meshgrid(*((np.arange(GRID) + 0.5) / GRID for _ in range(2)))
        rays = camera.unproject(np.column_stack([u.ravel() * camera.width, v.ravel() * camera.height]))
        for other in range(count):
            seen = np.zeros(len(rays), bool)
            for depth in OVERLAP_DEPTHS:
                points = rig_from_cam[k].apply(depth * rig.length * rays)
                which = np.full(len(rays), other)
                seen |= rig.sees(rig.project(points, which), which)
            out[k, other] = seen.mean()
    return _unwritable(out)


def _unwritable(values: np.ndarray) -> np.ndarray:
    values.flags.writeable = False
    return values
