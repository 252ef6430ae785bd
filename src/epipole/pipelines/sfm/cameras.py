"""Group images by camera, with initial intrinsics from EXIF or from a calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int32

from epipole.cameras import Camera, CameraModel, camera_model_named
from epipole.cameras.image_fit import (
    ImagePixels,
    ImageShape,
    camera_of_image,
    described_pixels,
    fit_notes,
    with_likely_principal_point,
)
from epipole.errors import ConfigError
from epipole.io.calibration.camera_params import camera_of_calibration, camera_of_images, refuse_impossible
from epipole.io.images.photographs import PhotographHeader
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.scene import Cameras

PRIOR_FOCAL = 1.2
"""Assumed focal length if nothing is known, in units of the longer side."""


@dataclass(frozen=True, slots=True, eq=False)
class GroupedCameras:
    """Cameras, and the camera of each image."""

    cameras: Cameras
    camera_of_image: Int32[np.ndarray, " n"]
    sources: tuple[str, ...]
    """Source of each camera's focal length, in words."""
    notes: tuple[str, ...] = ()
    """How known parameters were adapted to the images, and warnings about them."""


def group_cameras(headers: Mapping[str, PhotographHeader], config: ReconstructConfig) -> GroupedCameras:
    """Cameras of upright images, and the camera of each image.

    Images of the same make, model, size and focal length share a camera; without EXIF, images of the same size do. A
    known camera is rotated and scaled to match each image.

    Raises:
        ConfigError: the camera options do not match the images.
        FileFormatError: the calibration cannot be read.
    """
    if config.has_known_camera:
        return _known_cameras(headers, config)
    model = camera_model_named(config.camera_model or "SIMPLE_RADIAL")
    if config.single_camera:
        _check_one_size(headers)
        one = np.zeros(len(headers), np.int32)
        found = [h for h in headers.values() if h.focal_px]
        camera, source = _camera_of(found[0] if found else next(iter(headers.values())), model)
        return GroupedCameras(Cameras.from_list([camera], is_focal_trusted=[bool(found)]), one, (source,))
    groups: dict[tuple, int] = {}
    cameras: list[Camera] = []
    sources: list[str] = []
    rows: list[int] = []
    for header in headers.values():
        key = camera_key(header)
        if key not in groups:
            groups[key] = len(cameras)
            camera, source = _camera_of(header, model)
            cameras.append(camera)
            sources.append(source)
        rows.append(groups[key])
    trusted = [not s.startswith("assumed") for s in sources]
    columns = Cameras.from_list(cameras, is_focal_trusted=trusted)
    return GroupedCameras(columns, np.array(rows, np.int32), tuple(sources))


def camera_key(header: PhotographHeader) -> tuple[str, str, int, int, float]:
    """Key that images of one camera have in common; without make, model and focal length in the EXIF, only the size distinguishes cameras."""
    return header.make, header.model, header.width, header.height, round(header.focal_px or 0.0, 1)


def _check_one_size(headers: Mapping[str, PhotographHeader]) -> None:
    sizes = {(h.width, h.height) for h in headers.values()}
    if len(sizes) > 1:
        listed = ", ".join(f"{w}x{h}" for w, h in sorted(sizes))
        raise ConfigError(f"a single camera needs images of one size, but there are {listed}")


def _known_cameras(headers: Mapping[str, PhotographHeader], config: ReconstructConfig) -> GroupedCameras:
    """One camera per size and orientation of the images, all derived from the known one."""
    shapes = [_shape_of(header) for header in headers.values()]
    known, source, what = _known_camera(config, shapes)
    size = known.width, known.height
    described = described_pixels(size, shapes, what)
    known, odd = with_likely_principal_point(known)
    kinds = sorted(set(shapes))
    cameras = Cameras.from_list(
        [camera_of_image(known, shape, described) for shape in kinds],
        is_constant=[not config.refine_known] * len(kinds),
    )
    rows = np.array([kinds.index(shape) for shape in shapes], np.int32)
    notes = [*fit_notes(known, shapes, described, what), odd]
    return GroupedCameras(cameras, rows, (source,) * len(kinds), tuple(filter(None, notes)))


def _known_camera(config: ReconstructConfig, shapes: Sequence[ImageShape]) -> tuple[Camera, str, str]:
    """The given camera, the source of its focal length, and a name for messages."""
    if config.calibration is not None:
        what = f"calibration {config.calibration}"
        camera = camera_of_calibration(config.calibration, shapes[0].size(ImagePixels.STORED))
        refuse_impossible(camera, str(config.calibration))
        return camera, f"given by {config.calibration.name}", what
    found = camera_of_images(config.camera_model, shapes, config.camera_params or "")
    return found, "given", "the camera of camera_params"


def _shape_of(header: PhotographHeader) -> ImageShape:
    return ImageShape(header.width, header.height, header.orientation)


def _camera_of(header: PhotographHeader, model: CameraModel) -> tuple[Camera, str]:
    focal = header.focal_px or PRIOR_FOCAL * max(header.width, header.height)
    source = f"EXIF, {header.focal_source}" if header.focal_px else f"assumed {PRIOR_FOCAL} x the longer side"
    return Camera(
        model, header.width, header.height, model.initial_params(focal, header.width, header.height)
    ), source
