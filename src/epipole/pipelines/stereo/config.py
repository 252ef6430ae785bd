"""Options of `epipole stereo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from epipole.disparity_search.config import DisparityConfig


@dataclass(frozen=True, kw_only=True)
class StereoConfig(DisparityConfig):
    """Options of a stereo pair: those of the search, and what is done beside it."""

    uncalibrated: bool = False
    """Nothing is known of the cameras, and the pair is not rectified: do it through the fundamental matrix. There is no depth."""
    fill: bool = False
    """Guess what is not known, in files of their own: filled.pfm, and filled_mask.png where it was guessed."""
    max_frames: int = 20
    """Pairs taken from stereo video."""


@dataclass(frozen=True, kw_only=True)
class RigOptions:
    """What is known of the two cameras: a calibration, or numbers of a rectified pair; without either there is no depth."""

    calibration: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """File of both cameras, of epipole, OpenCV, Kalibr, KITTI or Middlebury; given twice for two files (ROS' or EuRoC's
    left and right, OpenCV's intrinsics and extrinsics). The pair is rectified by it."""
    cameras: tuple[int, int] | None = None
    """Left and right camera of a calibration that has more than two, counted from 0."""
    focal_px: float | None = None
    """Focal length of both rectified cameras."""
    baseline: float | None = None
    """Distance between the cameras, in the unit the depth is wanted in."""
    principal_point: tuple[float, float] | None = None
    """Of the left camera, x y; None: the middle of the picture."""
    principal_offset_px: float = 0.0
    """Principal point of the right camera minus that of the left, along x."""
    focal_sigma_px: float = 0.0
    """Standard deviation of the focal length; the three enter that of the depth."""
    baseline_sigma: float = 0.0
    principal_offset_sigma_px: float = 0.0


@dataclass(frozen=True, kw_only=True)
class ModelPair:
    """Two pictures of a finished reconstruction, in place of LEFT and RIGHT."""

    workspace: Path | None = None
    """Output folder of the reconstruction."""
    pair: tuple[str, str] | None = None
    """Names of the pictures."""
