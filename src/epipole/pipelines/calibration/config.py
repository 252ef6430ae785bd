"""Options of `epipole calibrate`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from epipole._declared import check_fields
from epipole.errors import ConfigError

_DICTIONARIES = ("APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11", "ARUCO_ORIGINAL")


@dataclass(frozen=True, kw_only=True)
class BoardConfig:
    """What the calibration board looks like."""

    kind: Literal["chessboard", "charuco", "apriltag"] = "chessboard"
    columns: int = 9
    """Inner corners in a row of a chessboard; squares of a ChArUco board; tags of an AprilTag grid."""
    rows: int = 6
    """The same in a column."""
    square: float = 1.0
    """Side of a square (or tag); its unit is that of the translations and depths. 1: they are in squares."""
    marker_share: float = 0.75
    """ChArUco: side of a marker divided by that of a square."""
    spacing: float = 0.3
    """AprilTag grid: gap between tags divided by the side of a tag (Kalibr's tagSpacing)."""
    dictionary: str = ""
    """Dictionary of the markers, OpenCV's name without DICT_; empty: 4X4_50 for ChArUco, APRILTAG_36h11 for
    AprilTags."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_fields(self)
        least = 1 if self.kind == "apriltag" else 3
        if min(self.columns, self.rows) < least:
            raise ConfigError(
                f"a {self.kind} needs at least {least} columns and rows, got {self.columns} x {self.rows}"
            )
        if not 0 < self.square < float("inf"):
            raise ConfigError(f"square must be positive and finite, got {self.square}")
        if not (0 < self.marker_share < 1 and self.spacing >= 0):
            raise ConfigError("marker_share must lie between 0 and 1, spacing must not be negative")
        name = self.dictionary
        sizes = name.split("_")[0] in ("4X4", "5X5", "6X6", "7X7") and name.split("_")[-1] in (
            "50",
            "100",
            "250",
            "1000",
        )
        if name and name not in _DICTIONARIES and not sizes:
            raise ConfigError(
                f"unknown dictionary {name!r}: 4X4_50 to 7X7_1000, or one of {', '.join(_DICTIONARIES)}"
            )

    @property
    def dictionary_name(self) -> str:
        """The dictionary, or the default of the kind of board."""
        return self.dictionary or ("APRILTAG_36h11" if self.kind == "apriltag" else "4X4_50")


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
        check_fields(self)
        if not (self.outlier_factor > 1 and self.max_view_factor > 1):
            raise ConfigError("outlier_factor and max_view_factor must be greater than 1")
