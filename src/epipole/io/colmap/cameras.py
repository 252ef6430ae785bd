"""COLMAP's camera models by number and name, and its half-pixel offset.

In COLMAP, (0.5, 0.5) is the center of the top-left pixel; in epipole, (0, 0) is.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike

from epipole._checks import as_float_array
from epipole.cameras import Camera, CameraModel, as_camera_model
from epipole.errors import ConfigError
from epipole.io._spherical import SPHERICAL_REFUSAL, is_spherical_word

HALF_PIXEL = 0.5

# Models that epipole does not have but that are, or may be, special cases of one that it has; the second value is
# the number of parameters in a file.
_SIMPLE_RADIAL_FISHEYE, _RADIAL_FISHEYE, _SIMPLE_FISHEYE, _FISHEYE = 8, 9, 14, 15
_OTHER_MODELS = {
    _SIMPLE_RADIAL_FISHEYE: ("SIMPLE_RADIAL_FISHEYE", 4),
    _RADIAL_FISHEYE: ("RADIAL_FISHEYE", 5),
    _SIMPLE_FISHEYE: ("SIMPLE_FISHEYE", 3),
    _FISHEYE: ("FISHEYE", 4),
}
# COLMAP models without an equivalent in epipole.
_UNREADABLE_MODELS = {
    7: "FOV",
    10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE",
    12: "SIMPLE_DIVISION",
    13: "DIVISION",
}
_MAX_SIZE = 2**31 - 1


def params_from_colmap(model: CameraModel | str | int, params: ArrayLike) -> Float64[np.ndarray, " p"]:
    """COLMAP's parameters, (p,), with the principal point in epipole's pixels.

    Raises:
        ConfigError: the model is unknown, or has another number of parameters.
        ShapeError: the parameters are not numbers.
    """
    return _shifted(model, params, -HALF_PIXEL)


def params_to_colmap(model: CameraModel | str | int, params: ArrayLike) -> Float64[np.ndarray, " p"]:
    """Parameters, (p,), with the principal point in COLMAP's pixels.

    Raises:
        ConfigError: the model is unknown, or has another number of parameters.
        ShapeError: the parameters are not numbers.
    """
    return _shifted(model, params, HALF_PIXEL)


def _shifted(model: CameraModel | str | int, params: ArrayLike, shift_px: float) -> np.ndarray:
    known, out = as_camera_model(model), np.array(as_float_array(params, "params"))
    if out.shape != (known.num_params,):
        names = ", ".join(known.param_names)
        raise ConfigError(f"{known.name} has {known.num_params} parameters ({names}), got {out.size}")
    out[list(known.principal_point_indices)] += shift_px
    return out


def num_params_of(model_id: int) -> int | None:
    """Number of parameters of a COLMAP model; None if epipole cannot read it."""
    if model_id in _OTHER_MODELS:
        return _OTHER_MODELS[model_id][1]
    return CameraModel(model_id).num_params if model_id in set(CameraModel) else None


def model_id_named(name: str) -> int | None:
    """COLMAP's number of a model; None if epipole cannot read it."""
    others = {other: number for number, (other, _) in _OTHER_MODELS.items()}
    return int(CameraModel[name]) if name in CameraModel.__members__ else others.get(name)


def unknown_model(model: int | str) -> str:
    """Why a camera model, given by number or name, cannot be read."""
    name = _UNREADABLE_MODELS.get(model, str(model)) if isinstance(model, int) else model[:40]
    if is_spherical_word(name):
        return f"unknown camera model {name}; {SPHERICAL_REFUSAL}"
    known = ", ".join([*CameraModel.__members__, *(other for other, _ in _OTHER_MODELS.values())])
    return f"unknown camera model {name}; supported are {known}"


def camera_from_colmap(model_id: int, width: int, height: int, params: np.ndarray) -> Camera:
    """The camera of a record with parameters in COLMAP's pixels.

    Raises:
        ConfigError: the values are invalid, or epipole does not support the model.
    """
    expected = num_params_of(model_id)
    if expected is None:
        raise ConfigError(unknown_model(model_id))
    if len(params) != expected:
        raise ConfigError(f"camera model {model_id} has {expected} parameters, got {len(params)}")
    if not (0 < width <= _MAX_SIZE and 0 < height <= _MAX_SIZE):
        raise ConfigError(f"invalid image size {width}x{height}")
    model, own_params = _as_own_model(model_id, np.asarray(params, np.float64))
    return Camera(model, width, height, params_from_colmap(model, own_params))


def _as_own_model(model_id: int, p: np.ndarray) -> tuple[CameraModel, np.ndarray]:
    if model_id == _FISHEYE:
        return CameraModel.OPENCV_FISHEYE, np.concatenate([p, np.zeros(4)])
    if model_id in (_SIMPLE_RADIAL_FISHEYE, _RADIAL_FISHEYE, _SIMPLE_FISHEYE):
        return CameraModel.OPENCV_FISHEYE, np.concatenate([p[:1], p, np.zeros(7 - len(p))])
    return CameraModel(model_id), p
