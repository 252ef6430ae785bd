"""Options of `epipole localize`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from epipole._checks import check_least, check_options
from epipole.config import FeatureConfig, MatchConfig
from epipole.errors import ConfigError
from epipole.pipelines.sfm.config import ReconstructConfig


@dataclass(frozen=True, kw_only=True)
class LocalizerConfig:
    """Options of the localization of one image."""

    neighbors: int = 10
    """Most similar images of the model that an image is matched with, at most."""
    further_neighbors: int = 20
    """Number of images with most of the matched points, whose other points are looked for, too."""
    max_error_px: float = 12.0
    """Points with a larger reprojection error are outliers of the first pose."""
    search_px: float = 6.0
    """Points of the model are looked for at most this far from their projections."""
    min_inliers: int = 20
    """Inliers needed to localize an image."""
    min_ratio: float = 0.1
    """Fraction of the matches that must be inliers."""
    seed: int = 0
    """Random seed."""
    features: FeatureConfig = field(default_factory=FeatureConfig)
    matching: MatchConfig = field(default_factory=lambda: MatchConfig(preemptive_features=0))

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range, or the features are not SIFT.
        """
        check_options(self)
        check_least(self, neighbors=1, further_neighbors=1, min_inliers=4, seed=0)
        for name in ("max_error_px", "search_px"):
            if not 0 < getattr(self, name) < 1e6:
                raise ConfigError(f"{name} must be positive and finite, got {getattr(self, name)}")
        if not 0 <= self.min_ratio <= 1:
            raise ConfigError(f"min_ratio must be from 0 to 1, got {self.min_ratio}")
        if self.features.kind != "sift":
            raise ConfigError(f"localization needs SIFT features, got kind {self.features.kind!r}")


@dataclass(frozen=True, kw_only=True)
class LocalizeConfig:
    """Options of `epipole localize`; the defaults suit most images."""

    camera_model: str | None = None
    """Camera model of images with unknown intrinsics: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL (default), ..."""
    camera_params: str | None = None
    """Known intrinsics of the images in COLMAP's order, comma separated; the first pixel's center is (0.5, 0.5)."""
    calibration: Path | None = None
    """Calibration file of the camera, from `epipole calibrate`, OpenCV, ROS or Kalibr."""
    include: tuple[str, ...] = ()
    """Use only images whose name, relative to the folder, matches one of these patterns."""
    exclude: tuple[str, ...] = ()
    """Leave out images whose name matches one of these patterns."""
    masks: Path | None = None
    """Folder of masks, MASKS/NAME.png; features in black areas are dropped."""
    max_frames: int = 200
    """Maximum number of frames taken from a video."""
    threads: int | None = None
    """Number of threads, which does not affect results. None: all processors."""
    localizer: Annotated[LocalizerConfig, tyro.conf.arg(name="")] = field(default_factory=LocalizerConfig)

    def __post_init__(self) -> None:
        """Check what does not depend on the images.

        Raises:
            ConfigError: options exclude each other, or a value is out of range.
        """
        check_options(self)
        self.for_images()

    def for_images(self) -> ReconstructConfig:
        """The options of reading images, their cameras and their features.

        Raises:
            ConfigError: camera parameters are not numbers, or options exclude each other.
        """
        return ReconstructConfig(
            camera_model=self.camera_model,
            camera_params=self.camera_params,
            calibration=self.calibration,
            include=self.include,
            exclude=self.exclude,
            masks=self.masks,
            max_frames=self.max_frames,
            threads=self.threads,
            features=self.localizer.features,
        )
