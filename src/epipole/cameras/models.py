"""The camera models: their names and parameters.

Pixel (0, 0) is the center of the top-left pixel. COLMAP's half-pixel shift is handled only in `io.colmap`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from epipole._checks import checked
from epipole.errors import ConfigError

MAX_PARAMS = 12
"""Length of the longest parameter vector; camera columns are padded to it with zeros."""


class CameraModel(IntEnum):
    """The models, with COLMAP's numbers, names and parameter order."""

    SIMPLE_PINHOLE = 0
    PINHOLE = 1
    SIMPLE_RADIAL = 2
    RADIAL = 3
    OPENCV = 4
    OPENCV_FISHEYE = 5
    FULL_OPENCV = 6

    @property
    def param_names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return _SPECS[self].names

    @property
    def num_params(self) -> int:
        """Length of the parameter vector."""
        return len(_SPECS[self].names)

    @property
    def focal_indices(self) -> tuple[int, ...]:
        """Indices of the focal lengths (one or two)."""
        return _SPECS[self].focal

    @property
    def principal_point_indices(self) -> tuple[int, int]:
        """Indices of cx and cy."""
        first = len(_SPECS[self].focal)
        return first, first + 1

    @property
    def distortion_indices(self) -> tuple[int, ...]:
        """Indices of the distortion coefficients (may be empty)."""
        return tuple(range(len(_SPECS[self].focal) + 2, self.num_params))

    @checked
    def initial_params(self, focal_px: float, width: int, height: int) -> np.ndarray:
        """Parameters of an undistorted camera with its principal point at the image center."""
        focal = [focal_px] * len(_SPECS[self].focal)
        zeros = [0.0] * len(self.distortion_indices)
        return np.array([*focal, 0.5 * (width - 1), 0.5 * (height - 1), *zeros])


@dataclass(frozen=True, slots=True)
class _Spec:
    names: tuple[str, ...]
    focal: tuple[int, ...]


_SPECS = {
    CameraModel.SIMPLE_PINHOLE: _Spec(("f", "cx", "cy"), (0,)),
    CameraModel.PINHOLE: _Spec(("fx", "fy", "cx", "cy"), (0, 1)),
    CameraModel.SIMPLE_RADIAL: _Spec(("f", "cx", "cy", "k"), (0,)),
    CameraModel.RADIAL: _Spec(("f", "cx", "cy", "k1", "k2"), (0,)),
    CameraModel.OPENCV: _Spec(("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"), (0, 1)),
    CameraModel.OPENCV_FISHEYE: _Spec(("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"), (0, 1)),
    CameraModel.FULL_OPENCV: _Spec(
        ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), (0, 1)
    ),
}


@checked
def camera_model_named(name: str) -> CameraModel:
    """The model with this name (case-insensitive).

    Raises:
        ConfigError: the name is unknown.
    """
    try:
        return CameraModel[name.strip().upper()]
    except KeyError:
        known = ", ".join(m.name for m in CameraModel)
        raise ConfigError(f"unknown camera model {name!r}: use one of {known}") from None


def as_camera_model(given: CameraModel | str | int) -> CameraModel:
    """The model itself, or the one with this name or number.

    Raises:
        ConfigError: the model is unknown.
    """
    if isinstance(given, CameraModel):
        return given
    if isinstance(given, str):
        return camera_model_named(given)
    try:
        return CameraModel(given)
    except (ValueError, TypeError):
        known = ", ".join(m.name for m in CameraModel)
        raise ConfigError(f"camera model must be one of {known}, got {given!r}") from None
