"""Which camera took which picture, and what is known of its lens before anything is matched."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Int32

from epipole.cameras import Camera, CameraModel, camera_model_named
from epipole.errors import ConfigError
from epipole.io.camera_params import camera_of_calibration, camera_of_text, refuse_impossible
from epipole.io.photographs import PhotographHeader
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.scene import Cameras

PRIOR_FOCAL = 1.2
"""Focal length assumed where nothing is known, in units of the longer side."""
FAR_OFF_MIDDLE = 0.2
"""A known principal point further from the middle, in units of the picture's side, is remarked on."""


def group_cameras(
    headers: Mapping[str, PhotographHeader], config: ReconstructConfig
) -> tuple[Cameras, Int32[np.ndarray, " n"], tuple[str, ...]]:
    """Cameras, the camera of each picture, and where each camera's focal length comes from, in words.

    Pictures of the same make, model, size and focal length share a camera; so do all of one size where none of
    this is recorded.

    Raises:
        ConfigError: the camera options do not fit the pictures.
        FileFormatError: the calibration cannot be read.
    """
    is_known = config.has_known_camera
    model = camera_model_named(config.camera_model or ("PINHOLE" if is_known else "SIMPLE_RADIAL"))
    if is_known or config.single_camera:
        width, height = _only_size(headers)
        one = np.zeros(len(headers), np.int32)
        if is_known:
            camera, source = _known_camera(config, model, width, height)
            return Cameras.from_list([camera], is_constant=[not config.refine_known]), one, (source,)
        found = [h for h in headers.values() if h.focal_px]
        camera, source = _camera_of(found[0] if found else next(iter(headers.values())), model)
        return Cameras.from_list([camera], is_focal_trusted=[bool(found)]), one, (source,)
    groups: dict[tuple, int] = {}
    cameras: list[Camera] = []
    sources: list[str] = []
    rows: list[int] = []
    for header in headers.values():
        # A picture without camera and focal length in its EXIF may come from any camera: sizes decide.
        key = (header.make, header.model, header.width, header.height, round(header.focal_px or 0.0, 1))
        if key not in groups:
            groups[key] = len(cameras)
            camera, source = _camera_of(header, model)
            cameras.append(camera)
            sources.append(source)
        rows.append(groups[key])
    trusted = [not s.startswith("assumed") for s in sources]
    return Cameras.from_list(cameras, is_focal_trusted=trusted), np.array(rows, np.int32), tuple(sources)


def _only_size(headers: Mapping[str, PhotographHeader]) -> tuple[int, int]:
    sizes = {(h.width, h.height) for h in headers.values()}
    if len(sizes) > 1:
        listed = ", ".join(f"{w}x{h}" for w, h in sorted(sizes))
        raise ConfigError(f"a single camera needs pictures of one size, but there are {listed}")
    return next(iter(sizes))


def _known_camera(
    config: ReconstructConfig, model: CameraModel, width: int, height: int
) -> tuple[Camera, str]:
    if config.calibration is not None:
        camera = camera_of_calibration(config.calibration, (width, height))
        refuse_impossible(camera, str(config.calibration))
        return camera, f"given by {config.calibration.name}"
    return camera_of_text(model, (width, height), config.camera_params or ""), "given"


def principal_point_note(camera: Camera) -> str:
    """What is odd about a known principal point; empty where nothing is.

    A lens stands over the middle of its sensor to within a few per cent; crops and rectified pictures may differ.
    """
    size = np.array([camera.width, camera.height])
    middle, point = (size - 1) / 2, camera.K[:2, 2]
    far = bool((np.abs(point - middle) > FAR_OFF_MIDDLE * size).any())
    is_swapped = np.abs(point[::-1] - middle).sum() < 0.25 * np.abs(point - middle).sum()
    if not (far or is_swapped):
        return ""
    ask = "were cx and cy swapped?" if is_swapped else "right only for a cropped or rectified picture"
    cx, cy = point + 0.5
    return (
        f"the known principal point, cx = {cx:g} and cy = {cy:g}, is far from the middle of the pictures "
        f"({camera.width / 2:g}, {camera.height / 2:g}): {ask}"
    )


def _camera_of(header: PhotographHeader, model: CameraModel) -> tuple[Camera, str]:
    focal = header.focal_px or PRIOR_FOCAL * max(header.width, header.height)
    source = f"EXIF, {header.focal_source}" if header.focal_px else f"assumed {PRIOR_FOCAL} x the longer side"
    return Camera(
        model, header.width, header.height, model.initial_params(focal, header.width, header.height)
    ), source
