"""Rectification of two cameras to side-by-side pinholes with parallel axes and common rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from epipole._checks import Declared, as_image, check_pixels, checked
from epipole.cameras import Camera, CameraModel
from epipole.cameras.visibility import project_visible
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.scene import DisparityMap, RectifiedRig, StereoReason, StereoRig

_WIDEST = 2.0  # tangent of the largest rectified angle from the axis: a plane cannot show 90 degrees
_BORDER = 65  # rays along each side of an image
_MOST_GROWTH = 4.0  # largest ratio of pixels of a rectified image to those of the larger input image
_SWAPPED_DEG = 135.0  # a baseline at a larger angle to the x axis indicates a swapped pair
_VERTICAL_DEG = 45.0
_IMAGES = (np.uint8, np.uint16, np.int16, np.float32, np.float64)

Matrix3 = Float64[np.ndarray, "3 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Rectification(Declared):
    """Lookup tables that resample both images, and the rectified rig."""

    rig: RectifiedRig
    rectified_from_left: Matrix3
    """Rotation from the left camera's axes to the rectified ones, which are common to both cameras."""
    rectified_from_right: Matrix3
    left_map_px: Float32[np.ndarray, "h w 2"]
    """Pixel in the left image of each rectified pixel."""
    right_map_px: Float32[np.ndarray, "h w 2"]
    left_valid: Bool[np.ndarray, "h w"]
    """Rectified pixels inside the left image."""
    right_valid: Bool[np.ndarray, "h w"]
    is_rotated: bool
    """Whether one camera is above the other, so that the rectified images are rotated by 90 degrees."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the rectified images."""
        height, width = self.left_valid.shape
        return width, height

    @property
    def Q(self) -> Float64[np.ndarray, "4 4"]:
        """(X, Y, Z, W)^T = Q (x, y, disparity, 1)^T, in the rectified left camera's frame, as in OpenCV."""
        rig = self.rig
        out = np.zeros((4, 4))
        out[0, 0] = out[1, 1] = 1.0
        out[0, 3], out[1, 3], out[2, 3] = -rig.cx, -rig.cy, rig.focal_px
        out[3, 2], out[3, 3] = 1.0 / rig.baseline, rig.principal_offset_px / rig.baseline
        return out

    def apply(self, left: Any, right: Any) -> tuple[np.ndarray, np.ndarray]:
        """Both images, resampled (bilinear); the border is replicated outside the original images.

        Raises:
            ShapeError: an argument is not an image.
        """
        images = []
        for name, image, table in (
            ("left", left, self.left_map_px),
            ("right", right, self.right_map_px),
        ):
            array = as_image(image, name)
            is_image = array.ndim in (2, 3) and array.size > 0 and array.dtype in _IMAGES
            if not is_image or (array.ndim == 3 and array.shape[2] > 4):
                raise ShapeError(f"{name} must be an image, got {array.shape} of {array.dtype}")
            images.append(
                cv2.remap(array, table[..., 0], table[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
            )
        return images[0], images[1]

    def __repr__(self) -> str:
        rotated = ", rotated by 90 degrees" if self.is_rotated else ""
        return f"Rectification({self.size[0]} x {self.size[1]}{rotated}, {self.rig!r})"


@checked
def rectify(rig: StereoRig) -> Rectification:
    """Rectify two calibrated cameras of any model (Fusiello, Trucco and Verri 2000, with the mean of both optical axes).

    The common x axis is along the baseline; z is as close as possible to both optical axes. The rectified pinholes have the smaller
    focal length, and show everything that either camera sees, up to 63 degrees from the axis, in the rows that both see. If one
    camera is above the other, the rectified images are rotated by 90 degrees.

    Raises:
        ConfigError: left and right are swapped.
        DegenerateGeometryError: the baseline is along the viewing direction, the cameras look in opposite directions, or they have no
            row in common.
    """
    toward_right = rig.right_from_left.inverse().translation
    right_rotation = rig.right_from_left.rotation
    axes = np.stack([np.array([0.0, 0.0, 1.0]), right_rotation[2]])
    x = toward_right / np.linalg.norm(toward_right)
    if np.hypot(x[0], x[1]) < 0.2:
        raise DegenerateGeometryError(
            "the baseline is along the viewing direction: such a pair cannot be rectified to planes"
        )
    if is_right_of_left(rig):
        raise ConfigError(
            "left and right are swapped: the calibration's right camera is to the left of its left one"
        )
    z = axes.sum(axis=0)
    z = z - (z @ x) * x
    if np.linalg.norm(z) < 0.2:
        raise DegenerateGeometryError("the cameras look in opposite directions")
    z = z / np.linalg.norm(z)
    rectified_from_left = np.stack([x, np.cross(z, x), z])
    rectified_from_right = rectified_from_left @ right_rotation.T
    focal = min(rig.left.focal_px, rig.right.focal_px)
    views = [
        _seen(rig.left, rectified_from_left),
        _seen(rig.right, rectified_from_right),
    ]
    low_x, high_x = min(v[0] for v in views), max(v[1] for v in views)
    low_y, high_y = max(v[2] for v in views), min(v[3] for v in views)
    if high_y - low_y < 2.0 / focal:
        raise DegenerateGeometryError("no row is seen by both cameras")
    pixels = max(rig.left.width * rig.left.height, rig.right.width * rig.right.height)
    area = (high_x - low_x) * (high_y - low_y)
    focal = min(focal, float(np.sqrt(_MOST_GROWTH * pixels / area)))
    width, height = max(1, round(focal * (high_x - low_x))), max(1, round(focal * (high_y - low_y)))
    check_pixels(width, height)
    cx, cy = -focal * low_x - 0.5, -focal * low_y - 0.5
    pinhole = Camera(CameraModel.PINHOLE, width, height, np.array([focal, focal, cx, cy]))
    left_map, left_valid = _table(pinhole, rig.left, rectified_from_left)
    right_map, right_valid = _table(pinhole, rig.right, rectified_from_right)
    return Rectification(
        RectifiedRig(focal, cx, cy, rig.baseline),
        rectified_from_left,
        rectified_from_right,
        left_map,
        right_map,
        left_valid,
        right_valid,
        bool(abs(np.rad2deg(np.arctan2(x[1], x[0]))) > _VERTICAL_DEG),
    )


@checked
def is_right_of_left(rig: StereoRig) -> bool:
    """Whether left and right are swapped: the right camera's center is to the left of the left camera."""
    x, y, _ = rig.right_from_left.inverse().translation
    return bool(abs(np.rad2deg(np.arctan2(y, x))) > _SWAPPED_DEG)


def _seen(camera: Camera, rectified_from_cam: np.ndarray) -> tuple[float, float, float, float]:
    """(smallest x, largest x, smallest y, largest y) of a grid of the image's rays on the plane z = 1."""
    x, y = np.linspace(-0.5, camera.width - 0.5, _BORDER), np.linspace(-0.5, camera.height - 0.5, _BORDER)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = camera.unproject(grid) @ rectified_from_cam.T
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = rays[:, :2] / rays[:, 2:]
    wide = np.hypot(rays[:, 0], rays[:, 1]) > _WIDEST * rays[:, 2]
    usable = np.isfinite(rays).all(axis=1) & ~wide & (rays[:, 2] > 0)
    if not usable.any():
        raise DegenerateGeometryError("a camera sees nothing in the common direction")
    (low_x, low_y), (high_x, high_y) = plane[usable].min(axis=0), plane[usable].max(axis=0)
    return float(low_x), float(high_x), float(low_y), float(high_y)


def _table(pinhole: Camera, camera: Camera, rectified_from_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixel in the camera's image of each pinhole pixel, and the mask of those inside."""
    shape = (pinhole.height, pinhole.width)
    v, u = np.mgrid[: pinhole.height, : pinhole.width]
    fx, fy, cx, cy = pinhole.params
    rays = np.stack([((u - cx) / fx).ravel(), ((v - cy) / fy).ravel(), np.ones(u.size)], axis=1)
    rays = rays @ rectified_from_cam
    pixels, inside = project_visible(camera, rays)
    pixels = np.nan_to_num(pixels, nan=-1e4, posinf=1e4, neginf=-1e4).clip(-1e4, 1e5)
    return pixels.astype(np.float32).reshape(*shape, 2), inside.reshape(shape)


@checked
def within_both(
    disparities: DisparityMap, left_valid: Bool[np.ndarray, "h w"], right_valid: Bool[np.ndarray, "h w"]
) -> DisparityMap:
    """Mark pixels outside the left image, or with matches outside the right image, as OUT_OF_VIEW."""
    if not disparities.reason.shape == left_valid.shape == right_valid.shape:
        raise ShapeError("disparities, left_valid and right_valid must have the same size")
    height, width = disparities.reason.shape
    matched = np.rint(np.arange(width) - np.nan_to_num(disparities.disparity_px)).astype(np.int64)
    rows = np.arange(height)[:, None]
    seen = left_valid & right_valid[rows, np.clip(matched, 0, width - 1)]
    outside = ~left_valid | (~seen & np.isfinite(disparities.disparity_px))
    nan = np.float32(np.nan)
    return DisparityMap(
        np.where(outside, nan, disparities.disparity_px),
        np.where(outside, nan, disparities.sigma_px),
        np.where(outside, np.uint8(StereoReason.OUT_OF_VIEW), disparities.reason),
    )
