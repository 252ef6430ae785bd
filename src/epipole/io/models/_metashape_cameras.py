"""Metashape's calibrations (user manual, appendix on camera models).

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y        (y' alike, p1 and p2 exchanged)
    u = w / 2 + cx + x' (f + b1) + y' b2,    v = h / 2 + cy + y' f

(x, y) is (X, Y) / Z, for a fisheye with the angle to the axis as its length. The center of the top-left pixel is
(0.5, 0.5). Compared with OPENCV, p1 and p2 are exchanged.
"""

from __future__ import annotations

import math
from xml.etree.ElementTree import Element

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError
from epipole.io._spherical import SPHERICAL_REFUSAL, is_spherical_word
from epipole.io.models._brown import COEFFICIENTS as BROWN_COEFFICIENTS
from epipole.io.models._brown import brown_coefficients, brown_model

FRAME, FISHEYE = "frame", "fisheye"
_CENTER_OF_FIRST_PIXEL = 0.5
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2", "b1", "b2")
# Elements of a calibration that do not affect the camera.
_WITHOUT_EFFECT = ("resolution", "date")


def camera_of_sensor(sensor: Element) -> Camera:
    """The camera of a sensor: its adjusted calibration, or the initial one if there is no other.

    Raises:
        ConfigError: the type is not supported, or a value is missing, invalid, or not supported.
    """
    calibrations = sorted(sensor.findall("calibration"), key=lambda each: each.get("class") != "adjusted")
    if not calibrations:
        raise ConfigError("it has no calibration")
    calibration = calibrations[0]
    kind = calibration.get("type", sensor.get("type", FRAME))
    if is_spherical_word(kind):
        raise ConfigError(f"type {kind[:40]}: {SPHERICAL_REFUSAL}")
    if kind not in (FRAME, FISHEYE):
        raise ConfigError(f"cameras of the type {kind[:40]!r} are not supported, only {FRAME} and {FISHEYE}")
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise ConfigError("it has no resolution")
    width, height = (_pixels(size, key) for key in ("width", "height"))
    values = _values(calibration)
    if "f" not in values:
        raise ConfigError("its calibration has no focal length f")
    f, k = values["f"], {key: values.get(key, 0.0) for key in _COEFFICIENTS}
    center = [
        0.5 * side + values.get(key, 0.0) - _CENTER_OF_FIRST_PIXEL
        for side, key in ((width, "cx"), (height, "cy"))
    ]
    model, distortion = _model_of(kind, k)
    return Camera(model, width, height, np.array([f + k["b1"], f, *center, *distortion]))


def _values(calibration: Element) -> dict[str, float]:
    known = {"f", "cx", "cy", *_COEFFICIENTS}
    values: dict[str, float] = {}
    for element in calibration:
        if element.tag in _WITHOUT_EFFECT:
            continue
        value = number_of(element.text, element.tag)
        if element.tag in values:
            raise ConfigError(f"duplicate value {element.tag} in a calibration")
        if element.tag not in known and value != 0.0:
            raise ConfigError(f"{element.tag[:40]} = {value:g} in a calibration is not supported")
        values[element.tag] = value
    return values


def _model_of(kind: str, k: dict[str, float]) -> tuple[CameraModel, list[float]]:
    unsupported = ("b2", "p1", "p2") if kind == FISHEYE else ("b2", "k4")
    for key in unsupported:
        if k[key]:
            advice = "fix it at zero and optimize again, or undistort the images in Metashape"
            raise ConfigError(f"{key} = {k[key]:g} of a {kind} camera is not supported; {advice}")
    if kind == FISHEYE:
        return CameraModel.OPENCV_FISHEYE, [k["k1"], k["k2"], k["k3"], k["k4"]]
    return brown_model(**{key: k[key] for key in BROWN_COEFFICIENTS})


def calibration_values(camera: Camera) -> tuple[str, dict[str, float]]:
    """Type and values of a camera's calibration; zeros are left out, as Metashape does.

    Raises:
        ConfigError: Metashape has no such distortion.
    """
    (fx, fy), (cx, cy) = np.diag(camera.K)[:2].tolist(), camera.K[:2, 2].tolist()
    is_fisheye = camera.model == CameraModel.OPENCV_FISHEYE
    if is_fisheye:
        values = camera.params[list(camera.model.distortion_indices)]
        k = dict(zip(("k1", "k2", "k3", "k4"), values.tolist()))
    else:
        k = brown_coefficients(camera, "Metashape")
    offset = {
        "cx": cx + _CENTER_OF_FIRST_PIXEL - 0.5 * camera.width,
        "cy": cy + _CENTER_OF_FIRST_PIXEL - 0.5 * camera.height,
    }
    found = {**offset, "b1": fx - fy, **k}
    return FISHEYE if is_fisheye else FRAME, {
        "f": fy,
        **{key: value for key, value in found.items() if value},
    }


def number_of(text: str | None, what: str) -> float:
    """The finite number in an element or an attribute.

    Raises:
        ConfigError: it is not one.
    """
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(f"{what[:40]} is not a finite number, got {(text or '')[:40]!r}")
    return value


def _pixels(size: Element, key: str) -> int:
    value = number_of(size.get(key), f"the {key} of a resolution")
    if not (0 < value < 2**31 and value == int(value)):
        raise ConfigError(f"invalid image size {key} = {value:g}")
    return int(value)
