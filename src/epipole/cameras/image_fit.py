"""Which pixels of an image a camera describes, and the camera of the pixels that are worked on.

A file stores pixels as the sensor has read them, and EXIF says how to turn them upright. A camera describes the stored pixels or
the upright ones, at the size of the file or at another scale: `camera_of_image` is the camera of the upright pixels at
the image's own size. Sizes tell both apart where an image is turned by 90 degrees, and nothing does where it is turned by
180: images of one sensor that are turned differently can share stored pixels alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_points
from epipole._declared import checked
from epipole.cameras.camera import Camera
from epipole.cameras.models import CameraModel
from epipole.errors import ConfigError

ROUNDING_PX = 1.0
"""Sides of a resized image are rounded: they differ by less than this from those of one factor."""
CLEAR = 0.25
"""A principal point is that of another size where it is nearer to its middle by this factor."""
FAR_OFF_MIDDLE = 0.2
"""A known principal point further from the middle, in units of the image's side, is remarked on."""
SWAPPED = 0.05
"""... and one that is off by more in both directions, and near the middle once swapped, is taken as swapped."""
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
    """As the file holds them, without its EXIF orientation: COLMAP's and a sensor's."""
    UPRIGHT = "upright"
    """With its EXIF orientation applied."""


class ImageShape(NamedTuple):
    """Size and EXIF orientation of an image file."""

    width: int
    """Of the upright image, in pixels."""
    height: int
    orientation: int = 1
    """EXIF orientation of the stored pixels, 1 to 8."""

    def size(self, pixels: ImagePixels) -> tuple[int, int]:
        """Width and height of the stored or the upright pixels."""
        is_swapped = self.orientation >= 5 and pixels is ImagePixels.STORED
        return (self.height, self.width) if is_swapped else (self.width, self.height)


@checked
def rotated_camera(camera: Camera, orientation: int) -> Camera:
    """The camera of an image after an EXIF orientation is applied to its pixels.

    The rays turn with the image, about the axis: x and y of the new ray are Q (x, y) with the Q that turns the image. Of a
    mirrored orientation (2, 4, 5, 7) they are mirrored.

    Raises:
        ConfigError: it is none of 1 to 8.
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
    """Upright pixel coordinates of stored ones, of an image whose stored pixels have this size.

    Raises:
        ConfigError: the orientation is none of 1 to 8.
    """
    stored = np.array(size, np.float64)
    upright = stored if orientation < 5 else stored[::-1]
    return (as_points(pixels, "pixels", 2) - (stored - 1) / 2) @ _rotate(orientation).T + (upright - 1) / 2


def inverse_orientation(orientation: int) -> int:
    """The orientation that turns upright pixels back to the stored ones."""
    return {6: 8, 8: 6}.get(orientation, orientation)


def _rotate(orientation: int) -> np.ndarray:
    if orientation not in _UPRIGHT_FROM_STORED:
        raise ConfigError(f"an EXIF orientation is 1 to 8, got {orientation}")
    return np.array(_UPRIGHT_FROM_STORED[orientation], np.float64)


def is_same_view(camera_size: tuple[int, int], size: tuple[int, int]) -> bool:
    """Whether images of these sizes can show the same at two scales: both sides by one factor, within rounding.

    Sizes that differ by a pixel alone do not: the image may have been cropped.
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
        ConfigError: the image does not show what the camera's does at one scale.
    """
    if not is_same_view((camera.width, camera.height), (width, height)):
        raise ConfigError(
            f"the camera is of images of {camera.width}x{camera.height}, but the image is {width}x{height}"
        )
    return camera if (camera.width, camera.height) == (width, height) else camera.scaled_to(width, height)


def camera_of_image(camera: Camera, shape: ImageShape, described: ImagePixels) -> Camera:
    """The camera of an image's upright pixels, from one that describes its stored or its upright pixels at any scale.

    Raises:
        ConfigError: the image does not show what the camera's does at one scale.
    """
    fitted = fitted_camera(camera, *shape.size(described))
    return rotated_camera(fitted, shape.orientation) if described is ImagePixels.STORED else fitted


def described_pixels(
    camera_size: tuple[int, int], shapes: Sequence[ImageShape], what: str = "the camera"
) -> ImagePixels:
    """Which pixels of images a camera of this size describes, if one sensor took all of them.

    The sizes decide. Where they fit both ways, images that are turned differently share the stored pixels; those that are
    all turned alike are taken to be described upright.

    Args:
        camera_size: width and height of the camera's images.
        shapes: of the images.
        what: holds the camera, for messages.

    Raises:
        ConfigError: the images fit neither way; the message names the sizes.
    """
    fits = {
        pixels: all(is_same_view(camera_size, shape.size(pixels)) for shape in shapes)
        for pixels in ImagePixels
    }
    if not any(fits.values()):
        sizes = sorted({shape.size(ImagePixels.UPRIGHT) for shape in shapes})
        others = [size for size in sizes if not is_same_view(camera_size, size)] or sizes
        listed = ", ".join(f"{w}x{h}" for w, h in others)
        raise ConfigError(f"{what} is of images of {camera_size[0]}x{camera_size[1]}, but these are {listed}")
    is_mixed = len({shape.orientation for shape in shapes}) > 1
    if all(fits.values()):
        return ImagePixels.STORED if is_mixed else ImagePixels.UPRIGHT
    return ImagePixels.STORED if fits[ImagePixels.STORED] else ImagePixels.UPRIGHT


def likely_size(principal_point: tuple[float, float] | None, shapes: Sequence[ImageShape]) -> tuple[int, int]:
    """The size of the images that parameters without a size describe: of all stored or all upright pixels.

    Args:
        principal_point: of the parameters, from the image's corner: where both sizes are possible it decides. None for none.
        shapes: of the images.

    Raises:
        ConfigError: the images have several sizes, stored and upright.
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
    """What a user should know of how a known camera was fitted to images; empty where they are its own size, not turned."""
    notes = []
    scaled = {shape.size(described) for shape in shapes} - {(camera.width, camera.height)}
    if scaled:
        listed = ", ".join(f"{w}x{h}" for w, h in sorted(scaled))
        notes.append(f"{what} is of images of {camera.width}x{camera.height}: it is scaled to {listed}")
    orientations = {shape.orientation for shape in shapes}
    if described is ImagePixels.STORED and orientations != {1}:
        notes.append(
            f"{what} is taken to describe the pixels as they are stored, before their EXIF orientation or rotation"
            " (the images are turned by it, and the camera with them)"
        )
    elif orientations & {2, 3, 4} and len(orientations) == 1 and _is_off_middle(camera):
        notes.append(
            f"{what} is taken to describe the upright images: their EXIF orientation or rotation turns all of them alike, and"
            " it may be of the stored pixels"
        )
    return notes


def _is_off_middle(camera: Camera) -> bool:
    """Whether a camera and the same one turned by 180 degrees differ by more than a pixel."""
    off = camera.K[:2, 2] - (np.array([camera.width, camera.height]) - 1) / 2
    return bool((np.abs(2.0 * off) > 1.0).any())


def with_likely_principal_point(camera: Camera) -> tuple[Camera, str]:
    """A known camera, and what is odd about its principal point (empty: nothing); swapped where it is of turned images.

    A lens stands over the middle of its sensor to within a few per cent; crops and rectified images may differ.
    """
    size = np.array([camera.width, camera.height])
    middle, point = (size - 1) / 2, camera.K[:2, 2]
    off = np.abs(point - middle)
    is_swapped = np.abs(point[::-1] - middle).sum() < CLEAR * off.sum()
    if not ((off > FAR_OFF_MIDDLE * size).any() or is_swapped):
        return camera, ""
    cx, cy = point + 0.5
    odd = (
        f"the known principal point, cx = {cx:g} and cy = {cy:g}, is far from the middle of the images "
        f"({camera.width / 2:g}, {camera.height / 2:g})"
    )
    if not is_swapped:
        return camera, f"{odd}: right only for a cropped or rectified image"
    ask = (
        f"{odd}: were cx and cy swapped, or are the parameters of images of {camera.height}x{camera.width} and these"
        f" of {camera.width}x{camera.height}?"
    )
    if not (off > SWAPPED * size).all():
        return camera, ask
    params = camera.params.copy()
    for pair in (list(camera.model.focal_indices), list(camera.model.principal_point_indices)):
        params[pair] = params[pair[::-1]]
    swapped = Camera(CameraModel(camera.model), camera.width, camera.height, params)
    return swapped, f"{ask} They are used swapped, with cx = {cy:g} and cy = {cx:g}"
