"""Relation between a camera's pixels and those of an image: EXIF orientation and scale.

A file stores pixels as read from the sensor, and EXIF gives the rotation that makes them upright. A camera describes the
stored pixels or the upright ones, at the file's size or at another scale; `camera_of_image` returns the camera of the upright
pixels at the image's own size. Sizes distinguish stored and upright pixels for rotations by 90 degrees, but not by 180. Images
of one sensor with different orientations can share only a camera of the stored pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_points, checked
from epipole.cameras.camera import Camera
from epipole.cameras.models import CameraModel
from epipole.errors import ConfigError

ROUNDING_PX = 1.0
"""Sides of a resized image are rounded: they differ by less than this from an exact common scale."""
CLEAR = 0.25
"""A principal point belongs to another size if it is closer to that size's center by this factor."""
FAR_OFF_MIDDLE = 0.2
"""Largest distance of a known principal point from the center without a note, as a fraction of the image's side."""
SWAPPED = 0.05
"""Distance in both directions above which a principal point is swapped, if it is near the center once swapped."""
_UPRIGHT_FROM_STORED = {
    1: [[1, 0], [0, 1]],
    2: [[-1, 0], [0, 1]],
    3: [[-1, 0], [0, -1]],
    4: [[1, 0], [0, -1]],
    5: [[0, 1], [1, 0]],
    6: [[0, -1], [1, 0]],
    7: [[0, -1], [-1, 0]],
    8: [[0, 1], [-1, 0]],
}


class ImagePixels(StrEnum):
    """The pixels of an image file that a camera describes."""

    STORED = "stored"
    """As stored in the file, before its EXIF orientation, as in COLMAP."""
    UPRIGHT = "upright"
    """With its EXIF orientation applied."""


class ImageShape(NamedTuple):
    """Size and EXIF orientation of an image file."""

    width: int
    """Width of the upright image, in pixels."""
    height: int
    orientation: int = 1
    """EXIF orientation of the stored pixels, 1 to 8."""

    def size(self, pixels: ImagePixels) -> tuple[int, int]:
        """Width and height of the stored or the upright pixels."""
        is_swapped = self.orientation >= 5 and pixels is ImagePixels.STORED
        return (self.height, self.width) if is_swapped else (self.width, self.height)


@checked
def rotated_camera(camera: Camera, orientation: int) -> Camera:
    """The camera of an image after applying an EXIF orientation to its pixels.

    Rays rotate with the image about the optical axis: x and y of the new ray are Q (x, y), where Q rotates the image. Mirroring
    orientations (2, 4, 5, 7) mirror them.
    mirrored orientation (2, 4, 5, 7) they are mirrored.

    Raises:
        ConfigError: the orientation is not from 1 to 8.
    """
    rotation = _rotate(orientation)
    size = np.array([camera.width, camera.height])
    new_size = size if orientation < 5 else size[::-1]
    params = camera.params.copy()
    names = camera.model.param_names
    focal = list(camera.model.focal_indices)
    if orientation >= 5:
        params[focal] = params[focal[::-1]]
    center = list(camera.model.principal_point_indices)
    params[center] = rotation @ (params[center] - (size - 1) / 2) + (new_size - 1) / 2
    if "p1" in names:  # (p2, p1) is a vector of the image plane
        tangential = [names.index("p2"), names.index("p1")]
        params[tangential] = rotation @ params[tangential]
    return Camera(camera.model, int(new_size[0]), int(new_size[1]), params)


@checked
def rotated_pixels(
    pixels: Float64[np.ndarray, "n 2"], size: tuple[int, int], orientation: int
) -> Float64[np.ndarray, "n 2"]:
    """Upright coordinates of stored pixels, for an image with this stored size.

    Raises:
        ConfigError: the orientation is not from 1 to 8.
    """
    stored = np.array(size, np.float64)
    upright = stored if orientation < 5 else stored[::-1]
    return (as_points(pixels, "pixels", 2) - (stored - 1) / 2) @ _rotate(orientation).T + (upright - 1) / 2


def inverse_orientation(orientation: int) -> int:
    """The orientation that maps upright pixels back to the stored ones."""
    return {6: 8, 8: 6}.get(orientation, orientation)


def _rotate(orientation: int) -> np.ndarray:
    if orientation not in _UPRIGHT_FROM_STORED:
        raise ConfigError(f"EXIF orientation must be from 1 to 8, got {orientation}")
    return np.array(_UPRIGHT_FROM_STORED[orientation], np.float64)


def is_same_view(camera_size: tuple[int, int], size: tuple[int, int]) -> bool:
    """Whether two sizes can be those of one image at two scales, within rounding.

    Sizes that differ by a single pixel are excluded: the image may have been cropped.
    """
    if camera_size == size:
        return True
    least = max((own - ROUNDING_PX) / side for own, side in zip(size, camera_size))
    most = min((own + ROUNDING_PX) / side for own, side in zip(size, camera_size))
    is_cropped = all(abs(own - side) <= ROUNDING_PX for own, side in zip(size, camera_size))
    return least < most and not is_cropped


@checked
def fitted_camera(camera: Camera, width: int, height: int) -> Camera:
    """The camera at the scale of an image.

    Raises:
        ConfigError: the aspect ratio of the image does not match the camera.
    """
    if not is_same_view((camera.width, camera.height), (width, height)):
        raise ConfigError(
            f"the camera is for images of {camera.width}x{camera.height}, but the image is {width}x{height}"
        )
    return camera if (camera.width, camera.height) == (width, height) else camera.scaled_to(width, height)


def camera_of_image(camera: Camera, shape: ImageShape, described: ImagePixels) -> Camera:
    """The camera of an image's upright pixels, from one of its stored or upright pixels at any scale.

    Raises:
        ConfigError: the aspect ratio of the image does not match the camera.
    """
    fitted = fitted_camera(camera, *shape.size(described))
    return rotated_camera(fitted, shape.orientation) if described is ImagePixels.STORED else fitted


def described_pixels(
    camera_size: tuple[int, int], shapes: Sequence[ImageShape], what: str = "the camera"
) -> ImagePixels:
    """The pixels that a camera of this size describes, for images of one sensor.

    The sizes decide. If both are possible, images with different orientations are assumed to share the stored pixels, and images
    with a common orientation are assumed to be described upright.

    Args:
        camera_size: width and height of the camera's images.
        shapes: of the images.
        what: source of the camera, for messages.

    Raises:
        ConfigError: neither fits the image sizes.
    """
    fits = {
        pixels: all(is_same_view(camera_size, shape.size(pixels)) for shape in shapes)
        for pixels in ImagePixels
    }
    if not any(fits.values()):
        sizes = sorted({shape.size(ImagePixels.UPRIGHT) for shape in shapes})
        others = [size for size in sizes if not is_same_view(camera_size, size)] or sizes
        listed = ", ".join(f"{w}x{h}" for w, h in others)
        raise ConfigError(
            f"{what} is for images of {camera_size[0]}x{camera_size[1]}, but these are {listed}"
        )
    is_mixed = len({shape.orientation for shape in shapes}) > 1
    if all(fits.values()):
        return ImagePixels.STORED if is_mixed else ImagePixels.UPRIGHT
    return ImagePixels.STORED if fits[ImagePixels.STORED] else ImagePixels.UPRIGHT


def likely_size(principal_point: tuple[float, float] | None, shapes: Sequence[ImageShape]) -> tuple[int, int]:
    """The image size of parameters given without a size: that of all stored or all upright pixels.

    Args:
        principal_point: principal point relative to the image's corner, to decide if both sizes are possible; None if unknown.
        shapes: of the images.

    Raises:
        ConfigError: both stored and upright images have several sizes.
    """
    stored = {shape.size(ImagePixels.STORED) for shape in shapes}
    upright = {shape.size(ImagePixels.UPRIGHT) for shape in shapes}
    if min(len(stored), len(upright)) > 1:
        listed = ", ".join(f"{w}x{h}" for w, h in sorted(upright))
        raise ConfigError(f"a single camera needs images of one size, but there are {listed}")
    if len(upright) > 1:
        return stored.pop()
    if len(stored) > 1:
        return upright.pop()
    own, other = upright.pop(), stored.pop()
    if principal_point is None:
        return own
    off = [np.abs(np.array(principal_point) - np.array(size) / 2).sum() for size in (own, other)]
    return other if off[1] < CLEAR * off[0] else own


def fit_notes(camera: Camera, shapes: Sequence[ImageShape], described: ImagePixels, what: str) -> list[str]:
    """Notes for the user on how a known camera was fitted to images; empty if nothing was changed."""
    notes = []
    scaled = {shape.size(described) for shape in shapes} - {(camera.width, camera.height)}
    if scaled:
        listed = ", ".join(f"{w}x{h}" for w, h in sorted(scaled))
        notes.append(f"{what} is for images of {camera.width}x{camera.height} and was scaled to {listed}")
    orientations = {shape.orientation for shape in shapes}
    if described is ImagePixels.STORED and orientations != {1}:
        notes.append(
            f"{what} is assumed to describe the stored pixels, before their EXIF orientation or rotation"
            " (which is applied to the images and to the camera)"
        )
    elif orientations & {2, 3, 4} and len(orientations) == 1 and _is_off_middle(camera):
        notes.append(
            f"{what} is assumed to describe the upright images: they all have the same EXIF orientation or rotation, so"
            " it could also describe the stored pixels"
        )
    return notes


def _is_off_middle(camera: Camera) -> bool:
    """Whether a camera changes by more than a pixel when rotated by 180 degrees."""
    off = camera.K[:2, 2] - (np.array([camera.width, camera.height]) - 1) / 2
    return bool((np.abs(2.0 * off) > 1.0).any())


def with_likely_principal_point(camera: Camera) -> tuple[Camera, str]:
    """A known camera and a note on its principal point (empty if plausible); swapped if it belongs to rotated images.

    The principal point is usually within a few per cent of the image center, except for cropped and rectified images.
    """
    size = np.array([camera.width, camera.height])
    middle, point = (size - 1) / 2, camera.K[:2, 2]
    off = np.abs(point - middle)
    is_swapped = np.abs(point[::-1] - middle).sum() < CLEAR * off.sum()
    if not ((off > FAR_OFF_MIDDLE * size).any() or is_swapped):
        return camera, ""
    cx, cy = point + 0.5
    odd = (
        f"the known principal point, cx = {cx:g} and cy = {cy:g}, is far from the center of the images "
        f"({camera.width / 2:g}, {camera.height / 2:g})"
    )
    if not is_swapped:
        return camera, f"{odd}, which is plausible only for cropped or rectified images"
    ask = (
        f"{odd}: are cx and cy swapped, or are the parameters for images of {camera.height}x{camera.width} and these"
        f" of {camera.width}x{camera.height}?"
    )
    if not (off > SWAPPED * size).all():
        return camera, ask
    params = camera.params.copy()
    for pair in (list(camera.model.focal_indices), list(camera.model.principal_point_indices)):
        params[pair] = params[pair[::-1]]
    swapped = Camera(CameraModel(camera.model), camera.width, camera.height, params)
    return swapped, f"{ask} They were swapped, to cx = {cy:g} and cy = {cx:g}"
