"""The camera and the pose of a frame in transforms.json."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, EpipoleError
from epipole.geometry import Rotation3
from epipole.io._spherical import SPHERICAL_REFUSAL, is_spherical_word
from epipole.io.colmap.cameras import HALF_PIXEL
from epipole.io.images.photographs import read_header
from epipole.io.names import path_inside

OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
PERSPECTIVE_KEYS, FISHEYE_KEYS = ("k1", "k2", "p1", "p2"), ("k1", "k2", "k3", "k4")

_RATIONAL_KEYS = (*PERSPECTIVE_KEYS, "k3", "k4", "k5", "k6")
# Supported coefficients of each camera model.
_PERSPECTIVE = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": (*PERSPECTIVE_KEYS, "k3"),
    "PERSPECTIVE": (*PERSPECTIVE_KEYS, "k3"),
    "FULL_OPENCV": _RATIONAL_KEYS,
}
_FISHEYE = {
    "OPENCV_FISHEYE": FISHEYE_KEYS,
    "FISHEYE": FISHEYE_KEYS,
    "RADIAL_FISHEYE": ("k1", "k2"),
    "SIMPLE_RADIAL_FISHEYE": ("k1",),
    "SIMPLE_FISHEYE": (),
}
_FOCAL_KEYS = {axis: (f"fl_{axis}", f"{axis}_fov", f"camera_angle_{axis}") for axis in "xy"}
_NUMBERS = ("w", "h", "cx", "cy", *_FOCAL_KEYS["x"], *_FOCAL_KEYS["y"], *_RATIONAL_KEYS)
_SIZE_KEYS = (("w", "width", "image_width"), ("h", "height", "image_height"))
_SAME_FOCAL = 0.01
"""Relative difference up to which two values of a focal length agree: files store rounded angles."""
_EXACT_ROTATION, _MOST_SCALE = 1e-3, 0.02 + 1e-9
"""Deviation of a rotation's singular values from 1 attributed to rounding, and the largest that is corrected."""
_AFFINE_TOLERANCE = 1e-6


def camera_of_frame(
    path: Path, content: Mapping[str, Any], frame: Mapping[str, Any], name: str
) -> tuple[Camera, list[str]]:
    """The camera of one frame, whose values override those of the file, and warnings about it.

    Raises:
        ConfigError: the camera model is unsupported, or values are invalid or contradict each other.
    """
    values = {**content, **frame}
    _require_finite(values)
    model_name, is_fisheye = _model_of(content, frame)
    width, height = _size(path, values, name)
    warnings: list[str] = []
    fx, fy = _focals(content, frame, (width, height), is_fisheye, warnings)
    cx, cy = float(values.get("cx", 0.5 * width)), float(values.get("cy", 0.5 * height))
    model, distortion = _distortion(values, model_name, is_fisheye)
    params = np.array([fx, fy, cx - HALF_PIXEL, cy - HALF_PIXEL, *distortion])
    return Camera(model, width, height, params), warnings


def _require_finite(values: Mapping[str, Any]) -> None:
    for key in _NUMBERS:
        value = values.get(key)
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{key} = {value} is not a finite number")


def _model_of(content: Mapping[str, Any], frame: Mapping[str, Any]) -> tuple[str, bool]:
    values = {**content, **frame}
    flag = values.get("is_fisheye")
    if flag is not None and not isinstance(flag, (bool, int)):
        raise ConfigError(f"is_fisheye must be true or false, got {flag!r}")
    if "camera_model" not in values:
        return ("OPENCV_FISHEYE", True) if flag else ("OPENCV", False)
    given = values["camera_model"]
    name = given.strip().upper() if isinstance(given, str) else ""
    if is_spherical_word(name):
        raise ConfigError(f"camera_model {given}: {SPHERICAL_REFUSAL}")
    if name not in _PERSPECTIVE and name not in _FISHEYE:
        known = ", ".join((*_PERSPECTIVE, *_FISHEYE))
        raise ConfigError(f"unknown camera_model {str(given)[:40]!r}; supported are {known}")
    is_fisheye = name in _FISHEYE
    if flag is not None and bool(flag) != is_fisheye:
        raise ConfigError(f"camera_model {name} contradicts is_fisheye = {flag}")
    return name, is_fisheye


def _distortion(values: Mapping[str, Any], name: str, is_fisheye: bool) -> tuple[CameraModel, list[float]]:
    has = (_FISHEYE if is_fisheye else _PERSPECTIVE)[name]
    given = {key: _coefficient(values, key) for key in _RATIONAL_KEYS}
    for key in given:
        if given[key] != 0.0 and key not in has:
            kind = "fisheye" if is_fisheye else "perspective"
            raise ConfigError(f"{key} of a {kind} camera ({name}) is not supported, got {given[key]:g}")
    if is_fisheye:
        return CameraModel.OPENCV_FISHEYE, [given[key] for key in FISHEYE_KEYS]
    if any(given[key] for key in _RATIONAL_KEYS[4:]):
        return CameraModel.FULL_OPENCV, [given[key] for key in _RATIONAL_KEYS]
    if any(given[key] for key in PERSPECTIVE_KEYS):
        return CameraModel.OPENCV, [given[key] for key in PERSPECTIVE_KEYS]
    return CameraModel.PINHOLE, []


def _coefficient(values: Mapping[str, Any], key: str) -> float:
    value = values.get(key)
    return 0.0 if value is None else float(value)


def _focals(
    content: Mapping[str, Any],
    frame: Mapping[str, Any],
    size: tuple[int, int],
    is_fisheye: bool,
    warnings: list[str],
) -> tuple[float, float]:
    """Focal lengths in pixels; if only one is given, pixels are assumed to be square."""
    x, y = (_given_focals(content, frame, axis, side, is_fisheye) for axis, side in zip("xy", size))
    if not x and not y:
        known = "fl_x" if is_fisheye else "fl_x, camera_angle_x or camera_angle_y"
        raise ConfigError(f"unknown focal length: add {known} to the file")
    _require_agreement(x)
    fx = next(iter((x or y).values()))
    fy = next(iter((y or x).values()))
    try:
        _require_agreement(y)
    except ConfigError as error:
        # Blender's angle_y is that of its sensor, independent of the image's shape: three values against one.
        if not ("fl_x" in x and "fl_y" in y and abs(fy - fx) <= _SAME_FOCAL * fx):
            raise
        warnings.append(f"{error}; using fl_y because it agrees with fl_x")
    return fx, fy


def _given_focals(
    content: Mapping[str, Any], frame: Mapping[str, Any], axis: str, side: int, is_fisheye: bool
) -> dict[str, float]:
    """Focal lengths along an axis by key, all from the frame or all from the file; the most reliable comes first."""
    keys = _FOCAL_KEYS[axis]
    values = frame if any(frame.get(key) is not None for key in keys) else content
    out: dict[str, float] = {}
    for key, unit_rad in zip(keys, (None, math.pi / 180, 1.0)):
        if values.get(key) is None:
            continue
        value = float(values[key])
        if unit_rad is None:
            out[key] = value
        elif not is_fisheye:  # the angle of view does not determine a fisheye's focal length
            if not 0.0 < unit_rad * value < math.pi:
                raise ConfigError(f"{key} = {value:g} is not a valid angle of view")
            out[key] = 0.5 * side / math.tan(0.5 * unit_rad * value)
    return out


def _require_agreement(focals: Mapping[str, float]) -> None:
    (first, focal), *others = focals.items() if focals else [("", 0.0)]
    for key, other in others:
        if not abs(other - focal) <= _SAME_FOCAL * abs(focal):
            raise ConfigError(f"{first} = {focal:g} contradicts {key}, which corresponds to {other:g} pixels")


def _size(path: Path, values: Mapping[str, Any], name: str) -> tuple[int, int]:
    """Width and height; missing values are read from the image."""
    sides: list[int | None] = []
    for keys in _SIZE_KEYS:
        given = {key: _pixels(values, key) for key in keys if key in values}
        if len(set(given.values())) > 1:
            raise ConfigError(" contradicts ".join(f"{key} = {value}" for key, value in given.items()))
        sides.append(next(iter(given.values()), None))
    width, height = sides
    if width is not None and height is not None:
        return width, height
    of_image = _image_size(path_inside(path.parent, name))
    for side, value, pixels in zip("wh", sides, of_image):
        if value is not None and value != pixels:
            raise ConfigError(f"{side} = {value}, but the image has {pixels} pixels")
    return of_image


def _pixels(values: Mapping[str, Any], key: str) -> int:
    value = float(values[key])
    if not (0 < value < 2**31 and value == int(value)):
        raise ConfigError(f"invalid image size {key} = {value:g}")
    return int(value)


def _image_size(file: Path) -> tuple[int, int]:
    try:
        header = read_header(file)
    except EpipoleError as error:
        raise ConfigError(f"w and h are missing, and the image {file} cannot be read") from error
    return header.width, header.height


def world_from_camera(frame: Mapping[str, Any]) -> tuple[np.ndarray | None, float]:
    """The pose (4, 4) with epipole's camera axes, None if not finite, and the size of the rotation's correction.

    Raises:
        ConfigError: the matrix is not a rigid motion.
    """
    given = np.array(frame["transform_matrix"], np.float64)
    if given.shape not in ((4, 4), (3, 4)):
        raise ConfigError("transform_matrix is not 4x4 numbers")
    if not np.isfinite(given).all():
        return None, 0.0
    scales = np.linalg.svd(given[:3, :3], compute_uv=False)
    deviation = float(np.abs(scales - 1.0).max())
    if not deviation <= _MOST_SCALE or np.linalg.det(given[:3, :3]) <= 0:
        raise ConfigError(
            f"transform_matrix does not contain a rotation (its scales are {scales[0]:.3g} to {scales[-1]:.3g})"
        )
    if len(given) == 4 and np.abs(given[3] - [0.0, 0.0, 0.0, 1.0]).max() > _AFFINE_TOLERANCE:
        raise ConfigError(
            f"transform_matrix has the last row {given[3].tolist()}, not 0 0 0 1 (is it transposed?)"
        )
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation3.nearest(given[:3, :3]).matrix, given[:3, 3]
    return out @ OPENGL_AXES, deviation if deviation > _EXACT_ROTATION else 0.0
