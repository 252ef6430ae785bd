"""COLMAP's rig_config.json: which images are of which camera of which rig, with known intrinsics and geometry where given.

    [{"cameras": [{"image_prefix": "left/", "ref_sensor": true},
                  {"image_prefix": "right/", "cam_from_rig_rotation": [1, 0, 0, 0], "cam_from_rig_translation": [-0.54, 0, 0],
                   "camera_model_name": "PINHOLE", "camera_params": [707.1, 707.1, 601.9, 183.1]}]}]

Rotations are quaternions (w, x, y, z). Images whose names differ only in the prefix are of one frame. One camera of each rig is its
reference, whose pose in the rig is the identity. Instead of `image_prefix`, which is all that COLMAP reads, a camera can have an
`image_pattern` with the wildcards * and ?: `"*_left.jpg"`. Images of one frame are those for which the wildcards are the same.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from epipole._checks import checked
from epipole.cameras import CameraModel, camera_model_named
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.io.colmap.cameras import params_from_colmap
from epipole.io.files import read_json
from epipole.io.images.name_patterns import NamePattern

_KNOWN_KEYS = {
    "image_prefix",
    "image_pattern",
    "ref_sensor",
    "cam_from_rig_rotation",
    "cam_from_rig_translation",
    "camera_model_name",
    "camera_params",
}


@dataclass(frozen=True, slots=True, eq=False)
class RigSensor:
    """A camera of a rig."""

    images: NamePattern
    """Names of its images."""
    cam_from_rig: Rigid3 | None
    """Its pose in the rig, identity for the reference; None if it is unknown."""
    camera_model: CameraModel | None
    """None if the intrinsics are unknown."""
    params: tuple[float, ...]
    """Intrinsics, with pixel centers at integers."""


@dataclass(frozen=True, slots=True, eq=False)
class RigConfig:
    """A rig; the first sensor is its reference."""

    sensors: tuple[RigSensor, ...]

    @property
    def is_known(self) -> bool:
        """Whether the geometry of all sensors is given."""
        return all(sensor.cam_from_rig is not None for sensor in self.sensors)


@checked
def read_rig_config(path: str | Path) -> tuple[RigConfig, ...]:
    """Read the rigs of a file.

    Raises:
        FileFormatError: the file is malformed, a rig has no or several references, or a prefix or pattern occurs twice.
    """
    path = Path(path)
    content = read_json(path)
    if not isinstance(content, list) or not content:
        raise FileFormatError(path, "expected a list of rigs, as in COLMAP's rig_config.json")
    rigs = tuple(_rig(path, number, entry) for number, entry in enumerate(content, 1))
    given = [sensor.images for rig in rigs for sensor in rig.sensors]
    twice = next((one for n, one in enumerate(given) if one in given[:n]), None)
    if twice is not None:
        raise FileFormatError(path, f"the image {twice.in_words} is given twice")
    return rigs


def _rig(path: Path, number: int, entry: Any) -> RigConfig:
    cameras = entry.get("cameras") if isinstance(entry, dict) else None
    if not isinstance(cameras, list) or not cameras or not all(isinstance(c, dict) for c in cameras):
        raise FileFormatError(path, f"rig {number} needs a list of cameras")
    references = [camera.get("ref_sensor", False) is True for camera in cameras]
    if sum(references) != 1:
        raise FileFormatError(
            path, f"rig {number} needs one camera with ref_sensor true, it has {sum(references)}"
        )
    sensors = [
        _sensor(path, f"rig {number}", camera, is_reference=r) for camera, r in zip(cameras, references)
    ]
    first = references.index(True)
    return RigConfig((sensors[first], *sensors[:first], *sensors[first + 1 :]))


def _sensor(path: Path, where: str, camera: Mapping[str, Any], *, is_reference: bool) -> RigSensor:
    unknown = sorted(set(camera) - _KNOWN_KEYS)
    if unknown:
        raise FileFormatError(path, f"{where}: unknown key {unknown[0]!r} of a camera")
    images = _image_names(path, where, camera)
    where = f"{where}, camera {images.text!r}"
    model, params = _intrinsics(path, where, camera)
    rotation, translation = camera.get("cam_from_rig_rotation"), camera.get("cam_from_rig_translation")
    if (rotation is None) != (translation is None):
        raise FileFormatError(
            path, f"{where}: give both cam_from_rig_rotation and cam_from_rig_translation, or none"
        )
    if is_reference:
        if rotation is not None and not _is_identity(_pose(path, where, rotation, translation)):
            raise FileFormatError(
                path, f"{where}: the reference defines the rig, so its pose must be the identity"
            )
        return RigSensor(images, Rigid3.identity(), model, params)
    pose = None if rotation is None else _pose(path, where, rotation, translation)
    return RigSensor(images, pose, model, params)


def _image_names(path: Path, where: str, camera: Mapping[str, Any]) -> NamePattern:
    prefix, pattern = camera.get("image_prefix"), camera.get("image_pattern")
    text = prefix if pattern is None else pattern
    if not isinstance(text, str) or not text or (prefix is not None and pattern is not None):
        raise FileFormatError(
            path,
            f"{where}: a camera needs either an image_prefix, the start of its image names, or an image_pattern",
        )
    images = NamePattern(text, has_wildcards=pattern is not None)
    if images.has_wildcards and not images.num_wildcards:
        raise FileFormatError(path, f"{where}: the image_pattern {text!r} has no wildcard (* or ?)")
    return images


def _pose(path: Path, where: str, rotation: Any, translation: Any) -> Rigid3:
    quat_wxyz = _numbers(path, where, rotation, "cam_from_rig_rotation", 4)
    norm = float(np.linalg.norm(quat_wxyz))
    if not 0.99 < norm < 1.01:
        raise FileFormatError(path, f"{where}: cam_from_rig_rotation must be a unit quaternion (w, x, y, z)")
    at = _numbers(path, where, translation, "cam_from_rig_translation", 3)
    return Rigid3(Rotation3.from_quat_wxyz(quat_wxyz / norm).matrix, at)


def _is_identity(pose: Rigid3) -> bool:
    return bool(np.allclose(pose.rotation, np.eye(3)) and np.allclose(pose.translation, 0.0))


def _intrinsics(
    path: Path, where: str, camera: Mapping[str, Any]
) -> tuple[CameraModel | None, tuple[float, ...]]:
    name, params = camera.get("camera_model_name"), camera.get("camera_params")
    if name is None and params is None:
        return None, ()
    if not isinstance(name, str) or not isinstance(params, list):
        raise FileFormatError(path, f"{where}: give both camera_model_name and camera_params, or none")
    try:
        model = camera_model_named(name)
    except ConfigError as error:
        raise FileFormatError(path, f"{where}: {error}") from error
    numbers = _numbers(path, where, params, "camera_params", model.num_params)
    return model, tuple(params_from_colmap(model, numbers).tolist())


def _numbers(path: Path, where: str, values: Any, name: str, count: int) -> np.ndarray:
    is_numeric = isinstance(values, list) and all(
        isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) and abs(v) < 1e9
        for v in values
    )
    if not is_numeric or len(values) != count:
        raise FileFormatError(path, f"{where}: {name} must be {count} numbers")
    return np.array(values, np.float64)
