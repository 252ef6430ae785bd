"""The content of a calibration file: cameras and their relative poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from epipole._checks import Declared, check_fields
from epipole.cameras import Camera
from epipole.errors import ShapeError
from epipole.geometry import Rigid3


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationFile(Declared):
    """The content of a calibration file."""

    cameras: tuple[Camera, ...]
    cam_from_rig: Rigid3
    """One row per camera; the first is the identity."""
    covariance: Float64[np.ndarray, "30 30"] | None = None
    """Covariance of a stereo pair, as in `StereoRig`."""

    def __post_init__(self) -> None:
        """Check the cameras and their poses.

        Raises:
            ShapeError: there are no cameras, or `cam_from_rig` does not have one row per camera.
            ConfigError: a field has the wrong type.
        """
        check_fields(self)
        if not self.cameras or self.cam_from_rig.batch_shape() != (len(self.cameras),):
            raise ShapeError(
                f"cam_from_rig must have one row for each of the {len(self.cameras)} cameras, "
                f"got {self.cam_from_rig.batch_shape()}"
            )

    def __repr__(self) -> str:
        errors = "no covariance" if self.covariance is None else "with covariance"
        return f"CalibrationFile({len(self.cameras)} cameras, {errors})"
