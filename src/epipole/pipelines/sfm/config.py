"""Options of `epipole reconstruct`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from epipole.config import FeatureConfig, MatchConfig, RansacConfig
from epipole.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class PairingConfig:
    """Options of choosing the pairs of images that are matched."""

    method: Literal["auto", "exhaustive", "sequential", "spatial", "retrieval"] = "auto"
    """auto: sequential for video; exhaustive up to a limit; beyond it spatial with GPS, else retrieval."""
    exhaustive_limit: int = 120
    """auto: up to so many images, all pairs."""
    neighbours: int = 30
    """retrieval and spatial: pairs per image."""
    overlap: int = 10
    """sequential: each image with so many that follow, and with its retrieved look-alikes."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        if min(self.neighbours, self.overlap, self.exhaustive_limit) < 1:
            raise ConfigError("neighbours, overlap and exhaustive_limit must be at least 1")


@dataclass(frozen=True, kw_only=True)
class MapperConfig:
    """Options of incremental mapping."""

    start_min_inliers: int = 100
    """Matches that the first pair must have; less is asked when no pair has them."""
    start_angle_deg: float = 16.0
    """Median triangulation angle from which on a wider one does not make a better first pair."""
    start_trials: int = 30
    """First pairs tried at most."""
    probe_images: int = 5
    """A first pair is kept or not when its model has grown to so many images."""
    min_match_agreement: float = 0.75
    """Share of the matches between registered images that a model must see as common points."""
    min_final_agreement: float = 0.6
    """The same for a finished model; below it other starts are tried."""
    restarts: int = 3
    """Other starts tried at most."""
    image_share: float = 0.3
    """An image whose matches agree less with the model is taken out again."""
    max_error_px: float = 4.0
    """Observations with a larger reprojection error are dropped."""
    min_angle_deg: float = 1.5
    """Points seen under a narrower angle are dropped: their depth is not known."""
    resection_max_error_px: float = 12.0
    resection_min_inliers: int = 30
    resection_min_ratio: float = 0.15
    """Share of the points in sight that must agree with an image's place."""
    min_observations: int = 15
    """An image left with fewer is taken out again."""
    local_images: int = 6
    """Images adjusted together after each new one."""
    global_growth: float = 1.25
    """The whole model is adjusted each time it has grown by this factor."""
    final_rounds: int = 5
    """Adjust, filter and triangulate again at most so often in the end."""
    settled_share: float = 5e-4
    """Share of changed observations below which the model counts as settled."""
    final_loss: Literal["trivial", "huber", "soft_l1", "cauchy"] = "cauchy"
    """Robust loss of the last adjustment; soft L1 before it."""
    loss_scale_px: float = 1.0
    """Residuals beyond this count less while the model grows."""
    final_scale_px: float = 0.5
    """The same in the last adjustment."""
    refine_focal: bool = True
    """Refine focal lengths that are not given as known."""
    refine_distortion: bool = True
    """Refine distortion that is not given as known."""
    max_models: int = 10
    """Components mapped at most when the pictures do not connect."""
    gps_sigma_m: float = 3.0
    """Standard deviation of GPS places; they take part in the adjustment with Cauchy's loss."""
    use_gps: bool = True
    """Use GPS of the EXIF as a robust prior and for the scale."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        if not self.max_error_px > 0 or not self.resection_max_error_px > 0 or not self.gps_sigma_m > 0:
            raise ConfigError("error bounds must be positive")
        if not self.global_growth > 1:
            raise ConfigError("global_growth must be greater than 1")


@dataclass(frozen=True, kw_only=True)
class ReconstructConfig:
    """Options of `epipole reconstruct`. A new user needs none."""

    camera_model: str | None = None
    """PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV or OPENCV_FISHEYE (SIMPLE_RADIAL unless parameters are given)."""
    camera_params: str | None = None
    """Known intrinsics, comma separated, in COLMAP's order and pixel convention: one camera took all pictures."""
    refine_known: bool = False
    """Refine known intrinsics too."""
    single_camera: bool = False
    """One camera took all pictures."""
    masks: Path | None = None
    """Folder of masks: MASKS/NAME.png; features where the mask is black are dropped."""
    pairs: Path | None = None
    """Text file of image pairs to match, two names a line."""
    database: Path | None = None
    """COLMAP database whose features and matches are used in place of own ones (its cameras too, unless given)."""
    max_frames: int = 200
    """Frames taken from a video."""
    executor: Literal["threads", "processes", "inline"] = "threads"
    """Who does the units of work."""
    threads: int | None = None
    """Number of threads; results do not depend on it. None: every processor."""
    features: FeatureConfig = field(default_factory=FeatureConfig)
    matching: MatchConfig = field(default_factory=MatchConfig)
    pairing: PairingConfig = field(default_factory=PairingConfig)
    verification: RansacConfig = field(default_factory=lambda: RansacConfig(min_inlier_ratio=0.3))
    mapper: MapperConfig = field(default_factory=MapperConfig)

    def __post_init__(self) -> None:
        """Check what can be checked without looking at the pictures.

        Raises:
            ConfigError: camera parameters are not numbers, or threads is not positive.
        """
        self.known_params()
        if self.max_frames < 2:
            raise ConfigError(f"max_frames must be at least 2, got {self.max_frames}")
        if self.threads is not None and self.threads < 1:
            raise ConfigError(f"threads must be at least 1, got {self.threads}")

    def known_params(self) -> tuple[float, ...] | None:
        """The numbers of `camera_params`; None when not given.

        Raises:
            ConfigError: not numbers.
        """
        if self.camera_params is None:
            return None
        try:
            return tuple(float(p) for p in self.camera_params.replace(",", " ").split())
        except ValueError:
            raise ConfigError(
                f"camera_params must be numbers separated by commas, got {self.camera_params!r}"
            ) from None
