"""OpenSfM's cameras, in coordinates relative to the image center and divided by the longer side of the image.

u = f x + c, with x the distorted coordinates on the image plane; pixel = max(w, h) u + ((w, h) - 1) / 2. The distortion of
`brown` is that of OPENCV with k3, that of `fisheye` and `fisheye_opencv` is that of OPENCV_FISHEYE.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError
from epipole.io._spherical import SPHERICAL_REFUSAL, is_spherical_word
from epipole.io.models._opensfm_values import number_in

_SIZE_KEYS = ("width", "height")
_CENTERED, _GENERAL = ("focal",), ("focal_x", "focal_y", "c_x", "c_y")
# Keys of the focal lengths and of the supported coefficients of each projection type.
_TYPES = {
    "perspective": (_CENTERED, ("k1", "k2")),
    "simple_radial": (_GENERAL, ("k1",)),
    "radial": (_GENERAL, ("k1", "k2")),
    "brown": (_GENERAL, ("k1", "k2", "p1", "p2", "k3")),
    "fisheye": (_CENTERED, ("k1", "k2")),
    "fisheye_opencv": (_GENERAL, ("k1", "k2", "k3", "k4")),
    "fisheye62": (_GENERAL, ("k1", "k2", "k3", "k4")),
    "fisheye624": (_GENERAL, ("k1", "k2", "k3", "k4")),
}
_PRIOR = "_prior"
"""Suffix of initial values, which do not affect the camera."""
_ROUNDING = 1e-12
"""Relative deviation of a principal point from the center, and of two focal lengths, that is only rounding."""


def camera_from_opensfm(values: Mapping[str, Any]) -> Camera:
    """The camera of an entry in `cameras`.

    Raises:
        ConfigError: the projection type is not supported, or a value is missing, invalid, or not supported.
    """
    name = values.get("projection_type", "perspective")
    if isinstance(name, str) and is_spherical_word(name):
        raise ConfigError(f"projection_type {name[:40]}: {SPHERICAL_REFUSAL}")
    if not isinstance(name, str) or name not in _TYPES:
        raise ConfigError(f"unknown projection_type {str(name)[:40]!r}; supported are {', '.join(_TYPES)}")
    intrinsics, coefficients = _TYPES[name]
    known = {"projection_type", *_SIZE_KEYS, *intrinsics, *coefficients}
    for key, value in values.items():
        if key not in known and not key.endswith(_PRIOR) and value != 0:
            raise ConfigError(f"{key} = {str(value)[:40]} of a {name} camera is not supported")
    width, height = (_size(values, key) for key in _SIZE_KEYS)
    scale = float(max(width, height))
    focal = [number_in(values, key) * scale for key in intrinsics[:2]]
    offset = [number_in(values, key, 0.0) * scale for key in intrinsics[2:]] or [0.0, 0.0]
    center = [offset[0] + 0.5 * (width - 1), offset[1] + 0.5 * (height - 1)]
    k = {key: number_in(values, key, 0.0) for key in coefficients}
    model, distortion = _model_of(name, k, is_square=len(set(focal)) == 1)
    if model in (CameraModel.SIMPLE_RADIAL, CameraModel.RADIAL):
        return Camera(model, width, height, np.array([focal[0], *center, *distortion]))
    return Camera(model, width, height, np.array([focal[0], focal[-1], *center, *distortion]))


def _model_of(name: str, k: Mapping[str, float], *, is_square: bool) -> tuple[CameraModel, list[float]]:
    """The model, and its distortion coefficients."""
    if name.startswith("fisheye"):
        return CameraModel.OPENCV_FISHEYE, [k.get(key, 0.0) for key in ("k1", "k2", "k3", "k4")]
    if name == "brown" and not any(k.values()):
        return CameraModel.PINHOLE, []
    if name != "brown" and is_square:
        return (
            (CameraModel.RADIAL, [k["k1"], k["k2"]]) if "k2" in k else (CameraModel.SIMPLE_RADIAL, [k["k1"]])
        )
    distortion = [k.get(key, 0.0) for key in ("k1", "k2", "p1", "p2")]
    if k.get("k3", 0.0):
        return CameraModel.FULL_OPENCV, [*distortion, k["k3"], 0.0, 0.0, 0.0]
    return CameraModel.OPENCV, distortion


def opensfm_camera(camera: Camera) -> dict[str, Any]:
    """The entry of a camera: `perspective` or `fisheye` if it suffices, else `brown` or `fisheye_opencv`.

    Raises:
        ConfigError: no projection type has the camera's distortion.
    """
    scale = float(max(camera.width, camera.height))
    center = 0.5 * (np.array([camera.width, camera.height]) - 1.0)
    focal, offset = np.diag(camera.K)[:2] / scale, (camera.K[:2, 2] - center) / scale
    k = np.zeros(8)
    values = camera.params[list(camera.model.distortion_indices)]
    k[: len(values)] = values
    is_simple = abs(focal[0] - focal[1]) <= _ROUNDING * focal[0] and (np.abs(offset) <= _ROUNDING).all()
    is_simple = bool(is_simple and not k[2:].any())
    names: tuple[str, ...]
    if camera.model == CameraModel.OPENCV_FISHEYE:
        name, names = ("fisheye", ("k1", "k2")) if is_simple else ("fisheye_opencv", ("k1", "k2", "k3", "k4"))
    else:
        name, names = (
            ("perspective", ("k1", "k2")) if is_simple else ("brown", ("k1", "k2", "p1", "p2", "k3"))
        )
        if k[5:].any():
            raise ConfigError("OpenSfM has no rational camera model (k4 to k6): undistort the images first")
    numbers = [focal[0]] if is_simple else [*focal, *offset]
    intrinsics = dict(zip(_CENTERED if is_simple else _GENERAL, map(float, numbers)))
    size = {"width": camera.width, "height": camera.height}
    return {"projection_type": name, **size, **intrinsics, **dict(zip(names, k.tolist()))}


def _size(values: Mapping[str, Any], key: str) -> int:
    value = number_in(values, key)
    if not (0 < value < 2**31 and value == int(value)):
        raise ConfigError(f"invalid image size {key} = {value:g}")
    return int(value)
