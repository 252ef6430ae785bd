"""Viewer scene of a calibration: camera poses and viewing directions of their pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from epipole.cameras import Camera
from epipole.errors import FileFormatError
from epipole.geometry import Rigid3
from epipole.io.calibration.files import CalibrationFile, read_calibration
from epipole.report.markup import plural
from epipole.report.space_scene import CameraLayer, FirstView, SpaceScene
from epipole.scene import Curve

CALIBRATION = "calibration.json"
UNIT = "the unit of the calibration"
"""Meters if the board was specified in meters."""
LINES, STEPS = 9, 32
"""Lines of the pixel grid in each direction, and segments of a line."""
GRID_RGB = ((120, 190, 220), (230, 170, 90))


def is_mine(path: Path) -> bool:
    """Whether a path is a calibration file, or a folder with one."""
    if path.is_dir():
        return (path / CALIBRATION).is_file() and not (path / "sparse").is_dir()
    if path.suffix.lower() not in (".json", ".yaml", ".yml", ".txt"):
        return False
    try:
        read_calibration(path)
    except FileFormatError:
        return False
    return True


def scene(path: Path) -> SpaceScene:
    """The cameras, each with a pixel grid projected onto a sphere, which shows the distortion.

    Raises:
        FileFormatError: the file cannot be read.
    """
    found = read_calibration(path / CALIBRATION if path.is_dir() else path)
    n = len(found.cameras)
    reach = _reach(found)
    names = tuple(f"camera {k}: {camera!r}" for k, camera in enumerate(found.cameras))
    layer = CameraLayer(
        "Cameras",
        names,
        found.cam_from_rig,
        np.array([camera.K for camera in found.cameras]),
        np.array([[camera.width, camera.height] for camera in found.cameras]),
    )
    rig_from_cam = found.cam_from_rig.inverse()
    curves = tuple(
        Curve(f"pixels of camera {k}", _grid(camera, rig_from_cam[k], reach), GRID_RGB[k % 2])
        for k, camera in enumerate(found.cameras)
    )
    middle = rig_from_cam.translation.mean(axis=0) + np.array([0.0, 0.0, 0.5 * reach])
    position = middle + reach * np.array([-1.1, -1.0, -1.9])
    return SpaceScene(
        title=path.resolve().name,
        words=f"{plural(n, 'camera')} and the viewing directions of a pixel grid",
        unit=UNIT if n > 1 else "arbitrary units",
        cameras=layer,
        curves=curves,
        view=FirstView(position, middle, np.array([0.0, -1.0, 0.0])),
    )


def _reach(found: CalibrationFile) -> float:
    """Distance of the grids from the cameras: three baselines, or 1."""
    far = float(np.abs(found.cam_from_rig.inverse().translation).max(initial=0.0))
    return 3.0 * far if far > 0 else 1.0


def _grid(camera: Camera, rig_from_cam: Rigid3, reach: float) -> np.ndarray:
    """Line segments (n, 2, 3) of the pixel grid, without those where the camera model has no ray."""
    along, across = np.linspace(0.0, 1.0, STEPS + 1), np.linspace(0.0, 1.0, LINES)
    u = np.concatenate([np.tile(along, LINES), np.repeat(across, STEPS + 1)])
    v = np.concatenate([np.repeat(across, STEPS + 1), np.tile(along, LINES)])
    pixels = np.stack([u * camera.width - 0.5, v * camera.height - 0.5], axis=1)
    rays = camera.unproject(pixels)
    with np.errstate(invalid="ignore"):
        rays = reach * rays / np.linalg.norm(rays, axis=1, keepdims=True)
    lines = rig_from_cam.apply(rays).reshape(2 * LINES, STEPS + 1, 3)
    pieces = np.stack([lines[:, :-1], lines[:, 1:]], axis=2).reshape(-1, 2, 3)
    return np.asarray(pieces[np.isfinite(pieces).all(axis=(1, 2))])
