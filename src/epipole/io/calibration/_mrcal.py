"""mrcal's .cameramodel files: a Python dictionary of literals, with comments.

Pixel centers are integers, as in epipole; `extrinsics` is (rotation vector, translation) of camera_from_reference.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from epipole.cameras import Camera
from epipole.errors import FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.io._named_numbers import numbers_of, size_of
from epipole.io.calibration.coefficients import camera_of_coefficients

_MODEL = re.compile(
    r"['\"](?:lensmodel|lens_model|distortion_model)['\"]\s*:\s*['\"](?:LENSMODEL|DISTORTION)_"
)
_BYTES = re.compile(r"\bb'(?:[^'\\\n]|\\.)*'|\bb\"(?:[^\"\\\n]|\\.)*\"")
_MOST_LETTERS = 1 << 19
_MOST_ROTATION_RAD = 1e3
_COEFFICIENTS = {"PINHOLE": 0, "NONE": 0, "OPENCV4": 4, "OPENCV5": 5, "OPENCV8": 8, "OPENCV12": 12}


def is_mrcal_text(text: str) -> bool:
    """Whether a text is a .cameramodel, judged by content."""
    return _MODEL.search(text) is not None


def mrcal_values(text: str) -> dict[str, Any]:
    """Names and values of a .cameramodel, without the optimization inputs, which are bytes.

    Raises:
        ValueError: the text is not a .cameramodel, or too large.
    """
    text = _BYTES.sub("None", text)
    if len(text) > _MOST_LETTERS:
        raise ValueError(f"it has more than {_MOST_LETTERS} characters")
    try:
        content = ast.literal_eval(text.strip())
    except (SyntaxError, TypeError, MemoryError, RecursionError) as error:
        raise ValueError(f"it is not a dictionary of literals ({type(error).__name__})") from error
    if not isinstance(content, dict):
        raise ValueError("it is not a dictionary")
    for key in ("lens_model", "distortion_model"):
        if key in content:
            content["lensmodel"] = content.pop(key)
    return content


def is_mrcal(content: Mapping[str, Any]) -> bool:
    """Whether these are the values of a .cameramodel."""
    return "lensmodel" in content


def mrcal_cameras(files: list[Path], contents: list[dict[str, Any]]) -> tuple[tuple[Camera, ...], Rigid3]:
    """One camera per file, and cam_from_rig with the first camera as the rig.

    Raises:
        FileFormatError: the camera model is not supported, or a number is missing.
    """
    cameras, cams_from_reference = [], []
    for path, content in zip(files, contents):
        if not is_mrcal(content):
            raise FileFormatError(path, "it is not a .cameramodel, but the other file is one")
        cameras.append(_camera(path, content))
        cams_from_reference.append(_cam_from_reference(path, content))
    poses = [cam @ cams_from_reference[0].inverse() for cam in cams_from_reference]
    return tuple(cameras), Rigid3(
        np.stack([pose.rotation for pose in poses]), np.stack([pose.translation for pose in poses])
    )


def _camera(path: Path, content: Mapping[str, Any]) -> Camera:
    name = str(content["lensmodel"])[:80]
    count = _COEFFICIENTS.get(name.removeprefix("LENSMODEL_").removeprefix("DISTORTION_"))
    if count is None:
        known = ", ".join(f"LENSMODEL_{known}" for known in _COEFFICIENTS if known != "NONE")
        raise FileFormatError(path, f"the camera model {name} is not supported; supported are {known}")
    numbers = numbers_of(path, content, "intrinsics")
    if len(numbers) != 4 + count:
        raise FileFormatError(path, f"{name} has {4 + count} intrinsics, got {len(numbers)}")
    fx, fy, cx, cy = numbers[:4]
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    size = size_of(path, *numbers_of(path, content, "imagersize", 2))
    return camera_of_coefficients(path, size, K, numbers[4:], is_fisheye=False)


def _cam_from_reference(path: Path, content: Mapping[str, Any]) -> Rigid3:
    key = "extrinsics" if "extrinsics" in content else "rt_cam_ref"
    numbers = numbers_of(path, content, key, 6)
    if not np.abs(numbers[:3]).max() < _MOST_ROTATION_RAD:
        raise FileFormatError(path, f"the rotation vector in {key} is too long")
    return Rigid3(Rotation3.exp(numbers[:3]).matrix, numbers[3:])
