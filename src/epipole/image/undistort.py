"""Undistortion of images and points."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from epipole._checks import check_pixels, checked
from epipole.cameras import Camera, CameraModel
from epipole.cameras.visibility import project_visible
from epipole.errors import DegenerateGeometryError

WIDEST = 3.0
"""Tangent of the largest angle from the optical axis: a plane cannot show 90 degrees."""
MAX_GROWTH = 4.0
"""Largest ratio of pixels in the undistorted to the distorted image: wider views are cropped."""
MIN_SIDE = 0.05
"""Smallest side of the undistorted image, relative to the distorted one: smaller crops are rejected."""
ENOUGH = 0.8
"""If corners have no ray: area, relative to the largest view, at which the view within the border is accepted."""
GRID = 129
"""Rays along each side of the view in the search for the largest rectangle."""
BORDER = 65  # rays along each side when checking a view
COARSE = 33  # rays along each side while moving the sides of a view
BISECTIONS = 12


class _View(NamedTuple):
    """A rectangle on the plane z = 1."""

    left: float
    right: float
    top: float
    bottom: float

    @property
    def area(self) -> float:
        return max(0.0, self.right - self.left) * max(0.0, self.bottom - self.top)


@checked
def undistort_points(
    pixels: Float64[np.ndarray, "n 2"], camera: Camera, pinhole: Camera | None = None
) -> Float64[np.ndarray, "n 2"]:
    """Undistort pixels to those of a pinhole camera.

    Args:
        pixels: (n, 2) in the camera's image.
        camera: the camera, of any model.
        pinhole: the pinhole camera; None: focal lengths, principal point and size of `camera`.

    Returns:
        (n, 2) pixels; NaN where the camera has no ray, or the pinhole camera cannot see it.
    """
    if pinhole is None:
        K = camera.K
        pinhole = Camera(
            CameraModel.PINHOLE, camera.width, camera.height, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
        )
    return pinhole.project(camera.unproject(pixels))


@checked
def undistorted_camera(camera: Camera) -> Camera:
    """The largest PINHOLE camera whose image shows nothing beyond this camera's border.

    The focal length is kept; the image is cropped to a rectangle whose rays are all visible to the camera. If the distortion does
    not reach the border of the image (it folds earlier, or rays are more than 90 degrees off the axis), that is the largest such
    rectangle within 71 degrees of the axis to each side.

    Raises:
        DegenerateGeometryError: the distortion covers less than a twentieth of the image's width or height.
    """
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    if camera.model in (CameraModel.SIMPLE_PINHOLE, CameraModel.PINHOLE):
        return Camera(CameraModel.PINHOLE, camera.width, camera.height, np.array([fx, fy, cx, cy]))
    view = _limited(_view_of_camera(camera), MAX_GROWTH * camera.width * camera.height / (fx * fy))
    width, height = _size_of(camera, view)
    if width < max(1.0, MIN_SIDE * camera.width) or height < max(1.0, MIN_SIDE * camera.height):
        raise DegenerateGeometryError(
            f"{camera} cannot be undistorted, as its distortion covers only {width}x{height} pixels of the image:"
            " calibrate the camera, or use a model with fewer coefficients"
        )
    params = np.array([fx, fy, -fx * view.left - 0.5, -fy * view.top - 0.5])
    return Camera(CameraModel.PINHOLE, width, height, params)


@checked
def undistort_image(
    rgb: UInt8[np.ndarray, "h w 3"], camera: Camera, pinhole: Camera
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Resample an image of `camera` to that of `pinhole` (bilinear); black outside its view.

    Raises:
        ConfigError: the new image is too large.
    """
    if camera.model in (CameraModel.SIMPLE_PINHOLE, CameraModel.PINHOLE):
        return rgb
    table = undistortion_map_px(camera, pinhole)
    return cv2.remap(rgb, table[..., 0], table[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def undistortion_map_px(camera: Camera, pinhole: Camera) -> Float32[np.ndarray, "h w 2"]:
    """Position in the image of `camera` of each pixel of `pinhole`; far outside if it is not visible.

    Raises:
        ConfigError: the new image is too large.
    """
    check_pixels(pinhole.width, pinhole.height)
    u, v = np.meshgrid(
        np.arange(pinhole.width, dtype=np.float64), np.arange(pinhole.height, dtype=np.float64)
    )
    rays = pinhole.unproject(np.stack([u.ravel(), v.ravel()], axis=1))
    if _is_visible(camera, _view_of(pinhole)):
        source = camera.project(rays)
    else:
        source, visible_mask = project_visible(camera, rays)
        inside = (source > -1.0).all(axis=1) & (source < [camera.width, camera.height]).all(axis=1)
        source[inside & ~visible_mask] = np.nan
    source = np.nan_to_num(source, nan=-1e4).astype(np.float32)
    return source.reshape(pinhole.height, pinhole.width, 2)


def _view_of_camera(camera: Camera) -> _View:
    """The view within the border of the image, or the largest visible one if the distortion does not reach the border."""
    within, is_whole = _view_within_border(camera)
    is_visible = within is not None and _is_visible(camera, _in_pixels(camera, within))
    if within is not None and is_visible and is_whole:
        return within
    largest = _largest_view(camera)
    return within if within is not None and is_visible and within.area > ENOUGH * largest.area else largest


def _view_within_border(camera: Camera) -> tuple[_View | None, bool]:
    """The view within the rays of the four sides of the image (None if a side has none), and whether all rays exist."""
    w, h = camera.width, camera.height
    x, y = np.linspace(-0.5, w - 0.5, BORDER), np.linspace(-0.5, h - 0.5, BORDER)
    sides, is_whole = [], True
    for pixels, axis in (
        (np.stack([np.full(BORDER, -0.5), y], 1), 0),
        (np.stack([np.full(BORDER, w - 0.5), y], 1), 0),
        (np.stack([x, np.full(BORDER, -0.5)], 1), 1),
        (np.stack([x, np.full(BORDER, h - 0.5)], 1), 1),
    ):
        rays = camera.unproject(pixels)
        in_front = rays[:, 2] > 0.05
        if not in_front.any():
            return None, False
        sides.append(rays[in_front, axis] / rays[in_front, 2])
        is_whole &= not np.isnan(rays).any()
    view = _View(
        max(float(sides[0].max()), -WIDEST),
        min(float(sides[1].min()), WIDEST),
        max(float(sides[2].max()), -WIDEST),
        min(float(sides[3].min()), WIDEST),
    )
    return view, is_whole


def _size_of(camera: Camera, view: _View) -> tuple[int, int]:
    """Width and height of the image of a view."""
    return int(camera.K[0, 0] * (view.right - view.left)), int(camera.K[1, 1] * (view.bottom - view.top))


def _in_pixels(camera: Camera, view: _View) -> _View:
    """The part of a view covered by an integer number of pixels."""
    width, height = _size_of(camera, view)
    return view._replace(right=view.left + width / camera.K[0, 0], bottom=view.top + height / camera.K[1, 1])


def _view_of(pinhole: Camera) -> _View:
    fx, fy, cx, cy = pinhole.K[0, 0], pinhole.K[1, 1], pinhole.K[0, 2], pinhole.K[1, 2]
    left, top = (-0.5 - cx) / fx, (-0.5 - cy) / fy
    return _View(left, left + pinhole.width / fx, top, top + pinhole.height / fy)


def _is_visible(camera: Camera, view: _View, num_rays: int = BORDER) -> bool:
    """Whether the camera sees the pixel centers of a view, checked on a grid that includes the border."""
    if view.area <= 0.0:
        return False
    half_x, half_y = 0.5 / camera.K[0, 0], 0.5 / camera.K[1, 1]
    left, right, top, bottom = (
        view.left + half_x,
        view.right - half_x,
        view.top + half_y,
        view.bottom - half_y,
    )
    if right < left or bottom < top:
        return False
    x, y = np.linspace(left, right, num_rays), np.linspace(top, bottom, num_rays)
    return bool(_visible_mask(camera, x, y).all())


def _visible_mask(camera: Camera, x: np.ndarray, y: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """Whether the camera sees the rays (x, y, 1) of a grid."""
    columns, rows = np.meshgrid(x, y)
    rays = np.stack([columns.ravel(), rows.ravel(), np.ones(columns.size)], axis=1)
    return project_visible(camera, rays)[1].reshape(columns.shape)


def _largest_view(camera: Camera) -> _View:
    """The largest rectangle of visible rays, to within a pixel.

    Raises:
        DegenerateGeometryError: no ray is visible.
    """
    u = np.linspace(0.0, camera.width - 1.0, GRID)
    v = np.linspace(0.0, camera.height - 1.0, GRID)
    rays = camera.unproject(np.stack([np.tile(u, GRID), np.repeat(v, GRID)], axis=1))
    rays = rays[rays[:, 2] > 0.05]  # neither behind nor NaN
    if not len(rays):
        raise DegenerateGeometryError(f"{camera} cannot be undistorted, as no pixel has a ray in front of it")
    plane = np.clip(rays[:, :2] / rays[:, 2:], -WIDEST, WIDEST)
    (left, top), (right, bottom) = plane.min(axis=0), plane.max(axis=0)
    x, y = np.linspace(left, right, GRID), np.linspace(top, bottom, GRID)
    columns, rows = largest_rectangle(_visible_mask(camera, x, y))
    view = _View(x[columns[0]], x[columns[1]], y[rows[0]], y[rows[1]])
    steps = _View(x[0] - x[1], x[1] - x[0], y[0] - y[1], y[1] - y[0])
    for side in ("left", "right", "top", "bottom"):
        view = _extended(camera, view, side, getattr(steps, side))
    return view


def largest_rectangle(mask: Bool[np.ndarray, "h w"]) -> tuple[tuple[int, int], tuple[int, int]]:
    """Columns (first, last) and rows (first, last) of the largest rectangle in which a mask is true.

    Row by row, with a stack of columns of increasing height. Sizes are measured between the centers of the first and the last
    pixel, so a single row or column has no area.
    """
    best, found = -1, ((0, 0), (0, 0))
    heights = np.zeros(mask.shape[1], np.int64)
    for row, line in enumerate(mask):
        heights = np.where(line, heights + 1, 0)
        stack: list[tuple[int, int]] = []
        for column, height in enumerate([*heights.tolist(), 0]):
            start = column
            while stack and stack[-1][1] >= height:
                start, tallest = stack.pop()
                area = (column - 1 - start) * (tallest - 1)
                if tallest > 0 and area > best:
                    best, found = area, ((start, column - 1), (row - tallest + 1, row))
            stack.append((start, height))
    return found


def _extended(camera: Camera, view: _View, side: str, step: float) -> _View:
    """Move a side of a view outwards, by less than a grid step, up to the limit of visibility."""
    low, high = 0.0, 1.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        moved = view._replace(**{side: np.clip(getattr(view, side) + middle * step, -WIDEST, WIDEST)})
        low, high = (middle, high) if _is_visible(camera, moved, COARSE) else (low, middle)
    return view._replace(**{side: float(np.clip(getattr(view, side) + low * step, -WIDEST, WIDEST))})


def _limited(view: _View, max_area: float) -> _View:
    """The view, shrunk about the optical axis if its area exceeds max_area."""
    shrink = np.sqrt(max_area / view.area) if view.area > max_area else 1.0
    if shrink == 1.0:
        return view
    x, y = np.clip(0.0, view.left, view.right), np.clip(0.0, view.top, view.bottom)
    return _View(
        float(x + shrink * (view.left - x)),
        float(x + shrink * (view.right - x)),
        float(y + shrink * (view.top - y)),
        float(y + shrink * (view.bottom - y)),
    )
