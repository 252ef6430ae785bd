"""The views of a model as files, read when they are needed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from epipole.cameras import Camera
from epipole.dense.view import DenseView
from epipole.geometry import Rigid3
from epipole.image import undistort_image, undistort_points, undistorted_camera
from epipole.io.images.photographs import GrayRange, read_mask_file
from epipole.io.images.rgba import read_rgba
from epipole.io.models.images import ModelImage

OPAQUE = 128
"""Least alpha of pixels that are used."""
_GRID = 33
"""Pixels along each side of an image that are undistorted to see how much of it remains."""
CACHED_VIEWS = 24
"""Views kept in memory: neighbors share most of their sources."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewFile:
    """An image of a model, its camera before and after undistortion, and its pose."""

    name: str
    image: ModelImage
    pinhole: Camera
    """Camera of the undistorted view at working size."""
    cam_from_world: Rigid3
    mask: Path | None
    limits: GrayRange | None
    fingerprint: str
    """Digest of everything that the view depends on."""

    # Copies that reach a worker one after the other are the same view, which is read once.
    def __eq__(self, other: object) -> bool:
        return isinstance(other, ViewFile) and self._identity() == other._identity()

    def __hash__(self) -> int:
        return hash(self._identity())

    def _identity(self) -> tuple[str, Path, str]:
        return self.name, self.image.path, self.fingerprint


def pinhole_of(camera: Camera, max_size_px: int) -> Camera:
    """Undistorted camera with at most `max_size_px` on its longer side.

    Raises:
        DegenerateGeometryError: the camera's distortion is invalid over almost all of its image.
    """
    full = undistorted_camera(camera)
    factor = max(full.width, full.height) / max_size_px
    if factor <= 1.0:
        return full
    return full.scaled_to(max(1, round(full.width / factor)), max(1, round(full.height / factor)))


def shown_fraction(camera: Camera) -> float:
    """Part of a camera's image that its undistorted image shows: a plane cannot show a fisheye's border."""
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, _GRID), np.linspace(0, camera.height - 1, _GRID))
    pinhole = undistorted_camera(camera)
    pixels = undistort_points(np.stack([x.ravel(), y.ravel()], axis=1), camera, pinhole)
    with np.errstate(invalid="ignore"):
        inside = (pixels > -0.5).all(axis=1) & (pixels < [pinhole.width - 0.5, pinhole.height - 0.5]).all(
            axis=1
        )
    return float(inside.mean())


@lru_cache(maxsize=CACHED_VIEWS)
def view_of_file(file: ViewFile) -> DenseView:
    """Read and undistort a view; the last ones stay in memory.

    Raises:
        FileFormatError: the image or its mask cannot be read.
    """
    rgb, used = _pixels_and_mask(file)
    if used is not None:
        used = _shrunk(np.repeat(used[..., None], 3, axis=2) * np.uint8(255), file)[..., 0] == 255
    return DenseView(file.name, _shrunk(rgb, file), file.pinhole, file.cam_from_world, used)


def full_image(file: ViewFile) -> np.ndarray:
    """The undistorted image at full size.

    Raises:
        FileFormatError: the image cannot be read.
    """
    image = file.image.read(limits=file.limits)
    return undistort_image(image, file.image.camera, undistorted_camera(file.image.camera))


def _pixels_and_mask(file: ViewFile) -> tuple[np.ndarray, np.ndarray | None]:
    """RGB, and the mask of pixels that are used; transparent ones are not."""
    rgba = read_rgba(file.image.path, orientation=file.image.orientation)
    rgb = file.image.read(limits=file.limits)
    used = None
    if file.mask is not None:
        used = read_mask_file(file.mask, file.name, size=(rgb.shape[1], rgb.shape[0]))
    if rgba is not None and not (rgba[..., 3] >= OPAQUE).all():
        opaque = rgba[..., 3] >= OPAQUE
        used = opaque if used is None else used & opaque
    return rgb, used


def _shrunk(rgb: np.ndarray, file: ViewFile) -> np.ndarray:
    """The image undistorted at full size, then averaged to the working size."""
    full = undistorted_camera(file.image.camera)
    flat = undistort_image(rgb, file.image.camera, full)
    size = file.pinhole.width, file.pinhole.height
    return (
        flat
        if size == (full.width, full.height)
        else np.asarray(cv2.resize(flat, size, interpolation=cv2.INTER_AREA))
    )
