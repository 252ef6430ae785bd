"""Options of `epipole stereo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from epipole._checks import check_options
from epipole.disparity_search.config import DisparityConfig


@dataclass(frozen=True, kw_only=True)
class StereoConfig(DisparityConfig):
    """Options of `epipole stereo`, including those of the disparity search."""

    uncalibrated: bool = False
    """Rectify the images of unknown cameras by their fundamental matrix; gives no depth."""
    fill: bool = False
    """Also write filled.pfm, with interpolated unknown pixels, and filled_mask.png, which marks them."""
    max_frames: int = 20
    """Largest number of pairs taken from stereo video."""
    cluster: str | None = None
    """Measure the pairs of folders or videos on a Dask cluster: tcp://HOST:PORT, tls://HOST:PORT, local:N or slurm:N."""
    shared_folder: bool = True
    """All machines of the cluster see images and output folder under the same paths; otherwise files are sent."""

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            ConfigError: an option is out of range.
        """
        super().__post_init__()
        if self.cluster is not None:
            from epipole.runs import Cluster  # not needed for --help

            Cluster(self.cluster)


@dataclass(frozen=True, kw_only=True)
class RigOptions:
    """The cameras: a calibration, or the parameters of a rectified pair; without them there is no depth."""

    calibration: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """Calibration file of the pair (epipole, OpenCV, Kalibr, KITTI, Middlebury); repeat for two files."""
    cameras: tuple[int, int] | None = None
    """Left and right camera of a calibration with more than two, counted from 0."""
    focal_px: float | None = None
    """Focal length of both rectified cameras, in pixels."""
    baseline: float | None = None
    """Distance between the cameras, in the unit of the depth."""
    principal_point: tuple[float, float] | None = None
    """Principal point of the left camera, x y; None: the image center."""
    principal_offset_px: float = 0.0
    """cx of the right camera minus cx of the left one (Middlebury's doffs)."""
    focal_sigma_px: float = 0.0
    """Standard deviation of the focal length, for the uncertainty of depth."""
    baseline_sigma: float = 0.0
    """Standard deviation of the baseline."""
    principal_offset_sigma_px: float = 0.0
    """Standard deviation of principal_offset_px."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: a value is out of range.
        """
        check_options(self, negative=("principal_offset_px",))


@dataclass(frozen=True, kw_only=True)
class ModelPair:
    """Two images of a finished reconstruction, in place of LEFT and RIGHT."""

    workspace: Path | None = None
    """Measure two images of this reconstruction, whose names must be given, too."""
    pair: tuple[str, str] | None = None
    """Names of the two images in the reconstruction."""
