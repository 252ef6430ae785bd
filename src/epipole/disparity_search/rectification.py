"""Rectification: what two cameras would see if they stood side by side with parallel axes and common rows."""

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

_WIDEST = 2.0  # tangent of the widest angle from the axis that is drawn: a plane cannot show 90 degrees
_BORDER = 65  # rays along each side of an image
_MOST_GROWTH = 4.0  # a rectified image has at most so many times the pixels of the larger one given
_SWAPPED_DEG = 135.0  # a baseline that points so far to the left belongs to a swapped pair
_VERTICAL_DEG = 45.0
_IMAGES = (np.uint8, np.uint16, np.int16, np.float32, np.float64)

Matrix3 = Float64[np.ndarray, "3 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Rectification(Declared):
    """Tables that resample both images, and the rig that would have taken the results."""

    rig: RectifiedRig
    rectified_from_left: Matrix3
    """Rotation from the left camera's axes to the rectified ones, which both images share."""
    rectified_from_right: Matrix3
    left_map_px: Float32[np.ndarray, "h w 2"]
    """Where in the left image each rectified pixel lies."""
    right_map_px: Float32[np.ndarray, "h w 2"]
    left_valid: Bool[np.ndarray, "h w"]
    """Pixels that the left camera sees."""
    right_valid: Bool[np.ndarray, "h w"]
    is_rotated: bool
    """The cameras stand one above the other: the rectified images lie on their side."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the rectified images."""
        height, width = self.left_valid.shape
        return width, height

    @property
    def Q(self) -> Float64[np.ndarray, "4 4"]:
        """(X, Y, Z, W)^T = Q (x, y, disparity, 1)^T, in the rectified left camera's axes, as OpenCV has it."""
        rig = self.rig
        out = np.zeros((4, 4))
        out[0, 0] = out[1, 1] = 1.0
        out[0, 3], out[1, 3], out[2, 3] = -rig.cx, -rig.cy, rig.focal_px
        out[3, 2], out[3, 3] = 1.0 / rig.baseline, rig.principal_offset_px / rig.baseline
        return out

    def apply(self, left: Any, right: Any) -> tuple[np.ndarray, np.ndarray]:
        """Both images, resampled (bilinear); where a camera saw nothing its border goes on.

        Raises:
            ShapeError: one of them is no image.
        """
        images = []
        for name, image, table in (
            ("left", left, self.left_map_px),
            ("right", right, self.right_map_px),
        ):
            array = as_image(image, name)
            is_image = array.ndim in (2, 3) and array.size > 0 and array.dtype in _IMAGES
            if not is_image or (array.ndim == 3 and array.shape[2] > 4):
                raise ShapeError(f"{name} must be an image, is {array.shape} of {array.dtype}")
            images.append(
                cv2.remap(array, table[..., 0], table[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
            )
        return images[0], images[1]

    def __repr__(self) -> str:
        rotated = ", turned on its side" if self.is_rotated else ""
        return f"Rectification({self.size[0]} x {self.size[1]}{rotated}, {self.rig!r})"


@checked
def rectify(rig: StereoRig) -> Rectification:
    """Rectify two calibrated cameras of any kind (Fusiello, Trucco and Verri 2000, with the axes' mean direction).

    The common x axis lies along the baseline; z is as near to both optical axes as that allows. The rectified pinhole has the
    smaller of both focal lengths and shows all that either camera sees, up to 63 degrees from the axis, in the rows
    that both see. Cameras one above the other give images that lie on their side.

    Raises:
        ConfigError: left and right are swapped.
        DegenerateGeometryError: the baseline lies along the viewing direction, or no row is seen by both.
    """
    toward_right = rig.right_from_left.inverse().translation
    right_rotation = rig.right_from_left.rotation
    axes = np.stack([np.array([0.0, 0.0, 1.0]), right_rotation[2]])
    x = toward_right / np.linalg.norm(toward_right)
    if np.hypot(x[0], x[1]) < 0.2:
        raise DegenerateGeometryError(
            "the baseline lies along the viewing direction: such a pair cannot be rectified to planes"
        )
    if is_right_of_left(rig):
        raise ConfigError(
            "left and right are swapped: the calibration's right camera stands left of its left one"
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
    """Whether left and right are swapped: the right camera's centre lies to the left of the left one's axis."""
    x, y, _ = rig.right_from_left.inverse().translation
    return bool(abs(np.rad2deg(np.arctan2(y, x))) > _SWAPPED_DEG)


def _seen(camera: Camera, rectified_from_cam: np.ndarray) -> tuple[float, float, float, float]:
    """(least x, largest x, least y, largest y) on the plane z = 1 of what the image's border and middle see."""
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
    """Where each pixel of the pinhole lies in the camera's image, and whether it does."""
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
    """The disparities of pixels that the left camera sees and whose matches the right one sees; others are OUT_OF_VIEW."""
    if not disparities.reason.shape == left_valid.shape == right_valid.shape:
        raise ShapeError("disparities, left_valid and right_valid must have one size")
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
