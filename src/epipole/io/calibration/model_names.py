"""Camera model names in calibration files; unknown names are rejected."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from epipole.errors import FileFormatError
from epipole.io._named_numbers import numbers_of
from epipole.io._spherical import SPHERICAL_REFUSAL, is_spherical_word

_SIDE = r"(_?(left|right|[lr]|\d))?"
_KEY = re.compile(
    rf"(distortion|lens|projection)_?(model|type){_SIDE}|camera_?model{_SIDE}|model_type", re.IGNORECASE
)
# Values under these keys may also be product names.
_LOOSE_KEY = re.compile(r"model|type|camera_?type|projection|lens|distortion", re.IGNORECASE)
_FLAG = re.compile(r"(is_)?fisheye(_model)?", re.IGNORECASE)
_OMNIDIRECTIONAL = re.compile(r"xi\d?|mirror_parameters", re.IGNORECASE)
_NEUTRAL = frozenset(("pinhole", "perspective", "camera", "opencv"))
_PERSPECTIVE = frozenset(
    (
        "plumb_bob",
        "rational_polynomial",
        "radtan",
        "radial_tangential",
        "brown_conrady",
        "brown",
        "plumbbob",
        "standard",
    )
)
_FISHEYE = frozenset(
    (
        "equidistant",
        "equi",
        "fisheye",
        "opencv_fisheye",
        "kannala_brandt",
        "kannala_brandt4",
        "kb4",
        "kannalabrandt",
    )
)
_WITHOUT = frozenset(("none", "no_distortion", "null", "undistorted", "rectified"))
# Models of other programs, which are rejected under any key.
_OTHERS = frozenset(
    (
        "omni",
        "omnidir",
        "omnidirectional",
        "mei",
        "ds",
        "double_sphere",
        "eucm",
        "ucm",
        "fov",
        "atan",
        "scaramuzza",
        "ocam",
    )
)
_MODEL_WORDS = (
    _PERSPECTIVE | _FISHEYE | _WITHOUT | _OTHERS | {"equirectangular", "spherical", "thin_prism_fisheye"}
)


class NamedModel(NamedTuple):
    """Meaning of the model names in a file."""

    is_fisheye: bool
    """Kannala-Brandt (OpenCV's fisheye module); otherwise Brown's or the rational polynomial."""
    is_named: bool
    """Whether a name specifies the distortion, not only the projection."""
    is_without_distortion: bool


def named_model(path: Path, content: Mapping[str, Any]) -> NamedModel:
    """Interpret the keys that name a camera model or a distortion.

    Raises:
        FileFormatError: a name is unknown, or two contradict each other.
    """
    kinds: dict[str, str] = {}
    for key, value in content.items():
        if not isinstance(key, str):
            raise FileFormatError(path, f"a key must be text, got {str(key)[:40]!r}")
        if _OMNIDIRECTIONAL.fullmatch(key) and not _is_zero(value):
            raise FileFormatError(path, f"{key} belongs to an omnidirectional camera, which is not supported")
        if _FLAG.fullmatch(key):
            if isinstance(value, str):
                raise FileFormatError(path, f"{key} must be 0 or 1, got {value[:40]!r}")
            kinds[f"{key} = {value}"] = "fisheye" if value else "perspective"
            continue
        if _LOOSE_KEY.fullmatch(key) and _normal(value) not in _MODEL_WORDS:
            continue  # the name of a product, or anything else
        if _KEY.fullmatch(key) or _LOOSE_KEY.fullmatch(key):
            for kind in _kinds_of(path, key, value):
                kinds[f"{key} {value}"] = kind
    found = set(kinds.values())
    if {"fisheye", "perspective"} <= found:
        first, second = (
            next(word for word, its in kinds.items() if its == kind) for kind in ("fisheye", "perspective")
        )
        raise FileFormatError(path, f"{first} contradicts {second}")
    return NamedModel("fisheye" in found, bool(found), "none" in found)


def require_coefficients(path: Path, words: NamedModel, coefficients: np.ndarray) -> None:
    """Check that the coefficients are consistent with the model names.

    Raises:
        FileFormatError: there is distortion although the names exclude it.
    """
    if words.is_without_distortion and coefficients.any():
        raise FileFormatError(path, "the distortion_model is none, but distortion coefficients are not zero")


def refuse_binning(path: Path, content: Mapping[str, Any]) -> None:
    """Reject ROS' binning and cropped regions, for which the camera matrix is not that of the image.

    Raises:
        FileFormatError: binning_x or binning_y is above 1, or roi has an offset.
    """
    roi = content.get("roi")
    offsets = roi if isinstance(roi, Mapping) else {}
    for key, most in (("binning_x", 1), ("binning_y", 1), ("x_offset", 0), ("y_offset", 0)):
        values = offsets if key.endswith("offset") else content
        if key in values and numbers_of(path, values, key, 1)[0] > most:
            raise FileFormatError(path, f"{key} = {values[key]} is not supported")


def _kinds_of(path: Path, key: str, value: Any) -> list[str]:
    """Kinds (fisheye, perspective, none) of one name, or of two joined by a hyphen; empty for a pinhole."""
    if value is None or value == "":
        return []
    word = _normal(value)
    if is_spherical_word(word):
        raise FileFormatError(path, f"{key} {value}: {SPHERICAL_REFUSAL}")
    projection, _, rest = word.partition("_")
    parts = [rest] if projection == "pinhole" and rest else [word]
    kinds = []
    for part in parts:
        kind = next(
            (
                kind
                for kind, words in (("fisheye", _FISHEYE), ("perspective", _PERSPECTIVE), ("none", _WITHOUT))
                if part in words
            ),
            None,
        )
        if kind is not None:
            kinds.append(kind)
        elif part not in _NEUTRAL:
            known = "pinhole, plumb_bob, rational_polynomial, radtan, fisheye, equidistant and none"
            raise FileFormatError(path, f"unknown {key} {str(value)[:60]}; supported are {known}")
    return kinds


def _normal(value: Any) -> str:
    return re.sub(r"[-\s]+", "_", str(value).strip().lower())


def _is_zero(value: Any) -> bool:
    return value is None or (isinstance(value, (int, float)) and value == 0)
