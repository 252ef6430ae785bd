"""Intrinsics as typed by the user: comma-separated numbers in COLMAP's order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from epipole._checks import checked
from epipole.cameras import Camera, CameraModel, camera_model_named
from epipole.cameras.image_fit import ImageShape, likely_size
from epipole.errors import ConfigError
from epipole.io.calibration.files import read_calibration
from epipole.io.colmap.model import params_from_colmap, params_to_colmap

MIN_FOCAL, MAX_FOCAL = 0.01, 1000.0
"""Plausible focal lengths in units of the longer side: beyond, a number was mistyped."""
MAX_OFFSET = 10.0
"""Largest distance of the principal point from the image corner, in the same unit."""
MAX_DISTORTION = 1e4


@checked
def params_of_text(text: str) -> tuple[float, ...]:
    """Parse the numbers of an option `camera_params`.

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
    """The camera of an option `camera_params`, for stored or upright images, whichever fits the principal point.

    Args:
        model: name of the camera model; None: PINHOLE.
        shapes: sizes of the images.
        text: the numbers, as in `camera_of_text`.

    Raises:
        ConfigError: the numbers do not fit this model, are not plausible, or the images differ in size.
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
        size: width and height of the images.
        text: the numbers in COLMAP's order; the principal point is relative to the image corner.

    Raises:
        ConfigError: the numbers do not fit this model, or are not plausible.
    """
    known = params_of_text(text)
    if len(known) != model.num_params:
        names = ",".join(model.param_names)
        example = ",".join(f"{value:g}" for value in _example(model, size))
        raise ConfigError(
            f"{model.name} takes {model.num_params} parameters ({names}), got {len(known)}: use, for example, {example}; cx"
            " and cy are relative to the image corner, half a pixel more than relative to the center of the first pixel"
        )
    camera = Camera(model, *size, params_from_colmap(model, np.array(known)))
    refuse_impossible(camera, "camera_params")
    return camera


def camera_of_calibration(path: Path, size: tuple[int, int]) -> Camera:
    """The camera in a calibration file with a single one; `size` is used if the file has no image size.

    Raises:
        ConfigError: the file has several cameras.
        FileFormatError: the file cannot be read.
    """
    found = read_calibration(path, size=size).cameras
    if len(found) != 1:
        each = " or ".join(
            f"camera_model {camera.model.name} and camera_params {text_of_camera(camera)}"
            for camera in found[:2]
        )
        raise ConfigError(
            f"calibration {path} has {len(found)} cameras, but these images come from one: pass the parameters of that camera, "
            f"{each}"
        )
    return found[0]


@checked
def text_of_camera(camera: Camera) -> str:
    """A camera's parameters in the format of `camera_of_text`, to seven digits."""
    return ",".join(f"{value:.7g}" for value in params_to_colmap(camera.model, camera.params))


@checked
def refuse_impossible(camera: Camera, where: str) -> None:
    """Reject implausible camera parameters.

    Args:
        camera: the camera.
        where: the source of the numbers, for the message.

    Raises:
        ConfigError: a focal length, principal point or distortion coefficient is outside its plausible range.
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
                f"{where}: {name} = {value:g} is not plausible for a camera of {camera.width}x{camera.height} pixels "
                f"(expected {low:g} to {high:g})"
            )


def _example(model: CameraModel, size: tuple[int, int]) -> list[float]:
    longer = float(max(size))
    focal = [float(round(longer))] * len(model.focal_indices)
    return [*focal, size[0] / 2, size[1] / 2, *[0.0] * len(model.distortion_indices)]
