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
    """OPENCV has k1, k2, p1, p2; FULL_OPENCV also k3 (k4 to k6 stay zero); OPENCV_FISHEYE k1 to k4."""
    refine_warp: bool = False
    """Estimate the bending of the board (two parameters); needs views from many directions."""
    outlier_factor: float = 5.0
    """Reject corners with residuals above this many robust standard deviations."""
    max_view_factor: float = 4.0
    """Reject views with residuals above this multiple of the median view's."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        check_options(self)
        for name in ("outlier_factor", "max_view_factor"):
            if not getattr(self, name) > 1:
                raise ConfigError(f"{name} must be greater than 1, got {getattr(self, name)}")
