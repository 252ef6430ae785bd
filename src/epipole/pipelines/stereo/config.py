"""Options of `epipole stereo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from epipole._checks import check_options
from epipole.disparity_search.config import DisparityConfig


@dataclass(frozen=True, kw_only=True)
class StereoConfig(DisparityConfig):
    """Options of a stereo pair: those of the disparity search, and more."""

    uncalibrated: bool = False
    """The cameras are unknown and the pair is not rectified: rectify it by the fundamental matrix. There is
    no depth then."""
    fill: bool = False
    """Also write filled.pfm, in which unknown pixels are guessed, and filled_mask.png, which marks them."""
    max_frames: int = 20
    """Largest number of pairs taken from stereo video."""


@dataclass(frozen=True, kw_only=True)
class RigOptions:
    """What is known of the two cameras: a calibration, or numbers of a rectified pair; else there is no depth."""

    calibration: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """Calibration file of both cameras (epipole, OpenCV, Kalibr, KITTI, Middlebury), by which the pair is
    rectified; give the option twice for two files (left and right of ROS or EuRoC, intrinsics and extrinsics
    of OpenCV)."""
    cameras: tuple[int, int] | None = None
    """Left and right camera of a calibration that has more than two, counted from 0."""
    focal_px: float | None = None
    """Focal length of both rectified cameras, in pixels."""
    baseline: float | None = None
    """Distance between the cameras, in the unit the depth is wanted in."""
    principal_point: tuple[float, float] | None = None
    """Principal point of the left camera, x y; None: the middle of the image."""
    principal_offset_px: float = 0.0
    """cx of the right camera minus cx of the left (Middlebury's doffs)."""
    focal_sigma_px: float = 0.0
    """Standard deviation of the focal length; like the next two it enters that of the depth."""
    baseline_sigma: float = 0.0
    """Standard deviation of the baseline."""
    principal_offset_sigma_px: float = 0.0
    """Standard deviation of principal_offset_px."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: one cannot be calculated with.
        """
        check_options(self, negative=("principal_offset_px",))


@dataclass(frozen=True, kw_only=True)
class ModelPair:
    """Two images of a finished reconstruction, in place of LEFT and RIGHT."""

    workspace: Path | None = None
    """Output folder of the reconstruction."""
    pair: tuple[str, str] | None = None
    """Names of the images."""
