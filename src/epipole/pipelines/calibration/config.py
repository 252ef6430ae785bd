"""Options of `epipole calibrate`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from epipole._checks import check_options
from epipole.config import BoardConfig
from epipole.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class CalibrationConfig:
    """Options of `epipole calibrate`."""

    board: BoardConfig = field(default_factory=BoardConfig)
    model: Literal["PINHOLE", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"] = "OPENCV"
    """OPENCV: two focal lengths, k1, k2, p1, p2; FULL_OPENCV: k3 too (k4 to k6 stay zero); OPENCV_FISHEYE: k1 to k4 of the angle."""
    refine_warp: bool = False
    """Estimate how the board is bent (two parameters); needs views from many sides."""
    outlier_factor: float = 5.0
    """Corners with residuals of more than this many robust standard deviations are left out."""
    max_view_factor: float = 4.0
    """Views with residuals of more than this many times the median view's are left out."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_options(self)
        if not (self.outlier_factor > 1 and self.max_view_factor > 1):
            raise ConfigError("outlier_factor and max_view_factor must be greater than 1")
