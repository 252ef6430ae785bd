"""What a calibration file holds: cameras, and how they stand to each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from epipole._declared import Declared, check_fields
from epipole.cameras import Camera
from epipole.errors import ShapeError
from epipole.geometry import Rigid3


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationFile(Declared):
    """What a calibration file holds."""

    cameras: tuple[Camera, ...]
    cam_from_rig: Rigid3
    """One row per camera; the first is the identity."""
    covariance: Float64[np.ndarray, "30 30"] | None = None
    """Of a pair, as in `StereoRig`."""

    def __post_init__(self) -> None:
        """Check the cameras and how they stand.

        Raises:
            ShapeError: there is no camera, or not a row of `cam_from_rig` for each.
            ConfigError: something else is of another kind.
        """
        check_fields(self)
        if not self.cameras or self.cam_from_rig.batch_shape() != (len(self.cameras),):
            raise ShapeError(
                f"cam_from_rig must have a row for each of {len(self.cameras)} cameras, "
                f"got {self.cam_from_rig.batch_shape()}"
            )

    def __repr__(self) -> str:
        errors = "no covariance" if self.covariance is None else "with covariance"
        return f"CalibrationFile({len(self.cameras)} cameras, {errors})"
