"""Intrinsics as a user types them: numbers separated by commas, in COLMAP's order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from epipole._declared import checked
from epipole.cameras import Camera, CameraModel, camera_model_named
from epipole.cameras.image_fit import ImageShape, likely_size
from epipole.errors import ConfigError
from epipole.io.calibration.files import read_calibration
from epipole.io.colmap.model import params_from_colmap, params_to_colmap

MIN_FOCAL, MAX_FOCAL = 0.01, 1000.0
"""Known focal lengths in units of the longer side: beyond, a number was mistyped."""
MAX_OFFSET = 10.0
"""Largest distance of a known principal point from the image's corner, in the same unit."""
MAX_DISTORTION = 1e4


@checked
def params_of_text(text: str) -> tuple[float, ...]:
    """The numbers of an option `camera_params`.

    Raises:
        ConfigError: not numbers, or not finite.
    """
    try:
        known = tuple(float(word) for word in text.replace(",", " ").split())
    except ValueError:
        raise ConfigError(f"camera_params must be numbers separated by commas, got {text!r}") from None
    if not all(math.isfinite(number) for number in known):
        raise ConfigError(f"camera_params must be finite numbers, got {text!r}")
    return known


@checked
def camera_of_images(model: str | None, shapes: Sequence[ImageShape], text: str) -> Camera:
    """The camera of an option `camera_params`, of the stored or upright size of its images that its numbers are of.

    Args:
        model: name of the camera model; None: PINHOLE.
        shapes: of the images.
        text: the numbers, as for `camera_of_text`.

    Raises:
        ConfigError: not the numbers of this model, such as no lens has, or the images have several sizes.
    """
    camera, known = camera_model_named(model or "PINHOLE"), params_of_text(text)
    cx, cy = camera.principal_point_indices
    point = (known[cx], known[cy]) if len(known) == camera.num_params else None
    return camera_of_text(camera, likely_size(point, shapes), text)


@checked
def camera_of_text(model: CameraModel, size: tuple[int, int], text: str) -> Camera:
    """The camera of an option `camera_params`.

    Args:
        model: the camera model.
        size: width and height of its images.
        text: the numbers in COLMAP's order; its principal point counts from the image's corner.

    Raises:
        ConfigError: not the numbers of this model, or such as no lens has.
    """
    known = params_of_text(text)
    if len(known) != model.num_params:
        names = ",".join(model.param_names)
        example = ",".join(f"{value:g}" for value in _example(model, size))
        raise ConfigError(
            f"{model.name} takes {model.num_params} parameters ({names}), got {len(known)}: such as {example}; cx and cy count"
            " from the image's corner, half a pixel more than from the first pixel's centre"
        )
    camera = Camera(model, *size, params_from_colmap(model, np.array(known)))
    refuse_impossible(camera, "camera_params")
    return camera


def camera_of_calibration(path: Path, size: tuple[int, int]) -> Camera:
    """The one camera of a calibration file, of the images that it was measured with; `size` is for files without one.

    Raises:
        ConfigError: the file is of several cameras.
        FileFormatError: it cannot be read.
    """
    found = read_calibration(path, size=size).cameras
    if len(found) != 1:
        each = " or ".join(
            f"camera_model {camera.model.name} and camera_params {text_of_camera(camera)}"
            for camera in found[:2]
        )
        raise ConfigError(
            f"calibration {path} holds {len(found)} cameras, and one camera took these images: give the parameters of that one, "
            f"{each}"
        )
    return found[0]


@checked
def text_of_camera(camera: Camera) -> str:
    """A camera's parameters as `camera_of_text` reads them, to seven digits."""
    return ",".join(f"{value:.7g}" for value in params_to_colmap(camera.model, camera.params))


@checked
def refuse_impossible(camera: Camera, where: str) -> None:
    """Refuse numbers that no lens has.

    Args:
        camera: the camera.
        where: its numbers come from.

    Raises:
        ConfigError: a focal length, principal point or distortion is out of all range.
    """
    longer = max(camera.width, camera.height)
    names, params = camera.model.param_names, camera.params
    for index, (name, value) in enumerate(zip(names, params)):
        if index in camera.model.focal_indices:
            low, high = MIN_FOCAL * longer, MAX_FOCAL * longer
        elif index in camera.model.principal_point_indices:
            low, high = -MAX_OFFSET * longer, MAX_OFFSET * longer
        else:
            low, high = -MAX_DISTORTION, MAX_DISTORTION
        if not low <= value <= high:
            raise ConfigError(
                f"{where}: {name} = {value:g} cannot be of a camera of {camera.width}x{camera.height} pixels "
                f"({low:g} to {high:g} is possible)"
            )


def _example(model: CameraModel, size: tuple[int, int]) -> list[float]:
    """Numbers as they might be, in COLMAP's order, for images of this size."""
    longer = float(max(size))
    focal = [float(round(longer))] * len(model.focal_indices)
    return [*focal, size[0] / 2, size[1] / 2, *[0.0] * len(model.distortion_indices)]
