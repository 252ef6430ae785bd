"""The image files of a model, in the orientation and at the scale that its cameras describe.

COLMAP and most similar programs read the stored pixels and ignore the EXIF orientation; epipole's models describe
upright images. Which of the two a model describes is determined from the sizes of its images, else from the colors of
its points at their keypoints, else from the program that wrote it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from epipole.cameras import Camera
from epipole.cameras.image_fit import (
    ImagePixels,
    ImageShape,
    fitted_camera,
    inverse_orientation,
    is_same_view,
    rotated_pixels,
)
from epipole.errors import ConfigError, EpipoleError, FileFormatError
from epipole.io.images.photographs import GrayRange, read_header, read_rgb
from epipole.io.names import path_inside
from epipole.scene import Reconstruction

MAX_COMPARED, COMPARED_PX = 6, 800
"""Number of images whose colors are compared with those of the points, and their longest side."""
MIN_COLORS = 50
MIN_CORRELATION, MIN_DIFFERENCE = 0.4, 0.2
"""Smallest correlation of brightness between points and pixels, and its margin over the other orientation."""


@dataclass(frozen=True, slots=True, eq=False)
class ModelImage:
    """An image file and the camera that matches its pixels."""

    path: Path
    camera: Camera
    """The model's camera, scaled to the file."""
    orientation: int
    """The EXIF orientation to apply: the file's, or 1 if the model describes stored pixels."""

    def read(
        self, max_size_px: int | None = None, *, limits: GrayRange | None = None
    ) -> UInt8[np.ndarray, "h w 3"]:
        """The pixels that the camera describes, as RGB.

        Args:
            max_size_px: as in `read_rgb`.
            limits: range of deep grayscale, as in `read_rgb`.

        Raises:
            FileFormatError: the file is damaged.
        """
        return read_rgb(self.path, max_size_px, limits=limits, orientation=self.orientation)


class ModelImages:
    """The images of a model in a folder, by their names in the model.

    Args:
        model: the model.
        folder: the folder of the images.
        is_own: whether epipole made the model, which then describes upright images.
    """

    def __init__(self, model: Reconstruction, folder: Path, *, is_own: bool) -> None:
        self._model, self._folder, self._is_own = model, folder, is_own
        self._row = {name: row for row, name in enumerate(model.images.name)}

    def find(self, name: str) -> ModelImage:
        """The file of an image, and the camera that matches its pixels.

        Raises:
            FileFormatError: the file is missing, damaged, or not a scaled version of the camera's images.
        """
        path = path_inside(self._folder, name)
        camera, shape = self._camera_of(self._row[name]), _shape_of(path)
        fits = _fits(camera, shape)
        pixels = self._described if len(fits) != 1 else fits[0]
        try:
            fitted = fitted_camera(camera, *shape.size(pixels))
        except ConfigError as error:
            raise FileFormatError(
                path,
                f"the image is {shape.width} x {shape.height}, but its camera {camera.width} x {camera.height}: images of another size"
                " must be scaled by a single factor",
            ) from error
        return ModelImage(path, fitted, shape.orientation if pixels is ImagePixels.UPRIGHT else 1)

    def loader(self, max_size_px: int) -> Callable[[str], np.ndarray | None]:
        """A function that reads an image by name; it returns None for images that cannot be read."""

        def load_image(name: str) -> np.ndarray | None:
            try:
                return self.find(name).read(max_size_px) if name in self._row else None
            except EpipoleError:
                return None

        return load_image

    def _camera_of(self, row: int) -> Camera:
        return self._model.cameras[int(self._model.camera_of_image[row])]

    @cached_property
    def _described(self) -> ImagePixels:
        """What the cameras describe, for images that fit both stored and upright."""
        rotated = {name: shape for name, shape in self._shapes().items() if shape.orientation != 1}
        fits = [_fits(self._camera_of(self._row[name]), shape) for name, shape in rotated.items()]
        by_size = {orientation[0] for orientation in fits if len(orientation) == 1}
        if len(by_size) == 1:
            return by_size.pop()
        by_color = self._described_by_colors(
            {name: rotated[name] for (name, orientation) in zip(rotated, fits) if len(orientation) == 2}
        )
        return by_color or (ImagePixels.UPRIGHT if self._is_own else ImagePixels.STORED)

    def _shapes(self) -> dict[str, ImageShape]:
        out = {}
        for row in np.flatnonzero(self._model.is_registered()):
            name = self._model.images.name[row]
            try:
                out[name] = _shape_of(path_inside(self._folder, name))
            except EpipoleError:
                continue  # reported when the image is requested
        return out

    def _described_by_colors(self, shapes: dict[str, ImageShape]) -> ImagePixels | None:
        """Decide by the colors of points at their keypoints, in images that fit both ways; None if undecided."""
        tracks = self._model.tracks
        count = np.bincount(tracks.image, minlength=len(self._model.images))
        names = sorted(shapes, key=lambda name: (-count[self._row[name]], name))[:MAX_COMPARED]
        parts = [colors for name in names if (colors := self._colors(name, shapes[name])) is not None]
        if not parts:
            return None
        points, stored, upright = np.concatenate(parts, axis=1)
        if len(points) < MIN_COLORS or min(points.std(), stored.std(), upright.std()) == 0.0:
            return None
        of_stored, of_upright = (float(np.corrcoef(points, own)[0, 1]) for own in (stored, upright))
        if max(of_stored, of_upright) < MIN_CORRELATION or abs(of_stored - of_upright) < MIN_DIFFERENCE:
            return None
        return ImagePixels.STORED if of_stored > of_upright else ImagePixels.UPRIGHT

    def _colors(self, name: str, shape: ImageShape) -> np.ndarray | None:
        """(3, n) brightness of points, and of their pixels if keypoints refer to the stored or to the upright image."""
        model, row = self._model, self._row[name]
        own = model.tracks.image == row
        camera = self._camera_of(row)
        size = camera.width, camera.height
        keypoints = model.images.keypoints_of(row)[model.tracks.keypoint[own]]
        try:
            rgb = read_rgb(path_inside(self._folder, name), COMPARED_PX, orientation=1)
        except EpipoleError:
            return None
        seen = [
            _colors_at(rgb, keypoints, size),
            _colors_at(rgb, rotated_pixels(keypoints, size, inverse_orientation(shape.orientation)), size),
        ]
        points = model.points.rgb[model.tracks.point_of_observation()[own]]
        inside = np.isfinite(seen).all(axis=(0, 2))
        return np.stack([points[inside].mean(axis=1), *(colors[inside].mean(axis=1) for colors in seen)])


def _colors_at(rgb: np.ndarray, keypoints: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(n, 3) colors at keypoints given for an image of the original `size`; NaN outside."""
    now = np.array([rgb.shape[1], rgb.shape[0]])
    at = np.rint((keypoints + 0.5) * now / size - 0.5)
    inside = (at >= 0).all(axis=1) & (at < now).all(axis=1)
    column, row = np.where(inside[:, None], at, 0).astype(np.int64).T
    return np.where(inside[:, None], rgb[row, column].astype(np.float64), np.nan)


def _fits(camera: Camera, shape: ImageShape) -> list[ImagePixels]:
    size = camera.width, camera.height
    return [pixels for pixels in ImagePixels if is_same_view(size, shape.size(pixels))]


def _shape_of(path: Path) -> ImageShape:
    header = read_header(path)
    return ImageShape(header.width, header.height, header.orientation)
