"""Cameras to render from: those of a file, or an orbit around the scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole._checks import MOST_RENDERED_PIXELS, check_pixels
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, FileFormatError, NoModelError
from epipole.geometry import Rigid3
from epipole.image import undistorted_camera
from epipole.io.convert import read_model
from epipole.io.models.llff import LLFF, read_llff
from epipole.io.names import flat_names
from epipole.pipelines.fields.config import RenderConfig
from epipole.scene import Reconstruction


@dataclass(frozen=True, slots=True, eq=False)
class RenderView:
    """One image to render."""

    name: str
    """File name without suffix."""
    camera: Camera
    cam_from_world: Rigid3


def render_views_of_model(source: Path, job: RenderConfig) -> list[RenderView]:
    """Registered cameras of a model, undistorted, sorted by name.

    Raises:
        FileFormatError: there is no readable model, or one of its cameras has too many pixels.
        NoModelError: no camera has a pose.
    """
    model: Reconstruction = (
        read_llff(source).reconstruction if (source / LLFF).is_file() else read_model(source)
    )
    cams_from_world, out = model.cams_from_world(), []
    rows = sorted(np.flatnonzero(model.is_registered()).tolist(), key=lambda k: model.images.name[k])
    for row, name in zip(rows, flat_names([model.images.name[row] for row in rows])):
        camera = undistorted_camera(model.cameras[int(model.camera_of_image[row])])
        camera = sized(camera, job.width)
        try:
            check_pixels(camera.width, camera.height, MOST_RENDERED_PIXELS)
        except ConfigError as error:
            raise FileFormatError(
                source, f"the camera of {name!a} is too large: {error}; pass --width"
            ) from error
        out.append(RenderView(name, camera, cams_from_world[row]))
    if not out:
        raise NoModelError(f"{source} has no camera with a pose")
    return out


def sized(camera: Camera, width: int | None) -> Camera:
    """The same field of view with images of another width."""
    if width is None or width == camera.width:
        return camera
    height = max(1, round(camera.height * width / camera.width))
    ratio = np.array([width / camera.width, height / camera.height])
    params = camera.params.copy()
    params[:2] *= ratio
    params[2:4] = (params[2:4] + 0.5) * ratio - 0.5
    return Camera(camera.model, width, height, params)


def orbit(position: np.ndarray, look_at: np.ndarray, up: np.ndarray, job: RenderConfig) -> list[RenderView]:
    """Views evenly spaced on a circle from `position` around the axis `up` through `look_at`."""
    width, height = job.width or 800, job.height or round((job.width or 800) * 3 / 4)
    focal = 0.5 * width / np.tan(0.5 * np.deg2rad(job.fov_deg))
    params = np.array([focal, focal, 0.5 * (width - 1), 0.5 * (height - 1)])
    camera = Camera(CameraModel.PINHOLE, width, height, params)
    is_closed = abs(job.rotation_deg) >= 360
    angles = np.deg2rad(np.linspace(0.0, job.rotation_deg, job.frames, endpoint=not is_closed))
    axis = up / np.linalg.norm(up)
    arm = position - look_at
    out = []
    for n, angle in enumerate(angles.tolist()):
        rotated = (
            arm * np.cos(angle)
            + np.cross(axis, arm) * np.sin(angle)
            + axis * (axis @ arm) * (1 - np.cos(angle))
        )
        out.append(RenderView(f"{n:05d}", camera, _facing(look_at + rotated, look_at, axis)))
    return out


def _facing(position: np.ndarray, look_at: np.ndarray, up: np.ndarray) -> Rigid3:
    """cam_from_world of a camera with x right, y down, and z toward its target."""
    ahead = (look_at - position) / np.linalg.norm(look_at - position)
    right = np.cross(ahead, up)
    if np.linalg.norm(right) < 1e-6:  # straight down or up
        right = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    return Rigid3(rotation, -rotation @ position)
