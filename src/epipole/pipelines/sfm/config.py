"""Options of `epipole reconstruct`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from epipole._checks import check_least, check_options
from epipole.config import ANCHOR_FILES, AnchorOptions, FeatureConfig, MatchConfig, RansacConfig
from epipole.errors import ConfigError

MAX_SEED = 2**32 - 1


@dataclass(frozen=True, kw_only=True)
class PairingConfig:
    """Options for choosing which pairs of images are matched."""

    method: Literal["auto", "exhaustive", "sequential", "spatial", "retrieval"] = "auto"
    """auto: sequential for video; else exhaustive for few images; else spatial or, without GPS, retrieval."""
    exhaustive_limit: int = 120
    """auto: for up to this many images, all pairs are candidates; of more than 60, those with the nearest neighbors are matched first."""
    neighbors: int = 30
    """retrieval and spatial: pairs per image."""
    first_neighbors: int = 10
    """The nearest of them, which are matched first; of the others, pairs with many points in common by then are not matched."""
    expansion: int = 10
    """retrieval and spatial: further pairs of each weakly connected image, in up to three rounds, with neighbors of its neighbors."""
    overlap: int = 10
    """sequential: number of following images to match with each image, besides similar ones found by retrieval."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        check_options(self)
        check_least(self, neighbors=1, first_neighbors=1, expansion=0, overlap=1, exhaustive_limit=1)


@dataclass(frozen=True, kw_only=True)
class MapperConfig:
    """Options of mapping."""

    method: Literal["auto", "incremental", "global"] = "auto"
    """global: all rotations, then all positions at once; incremental: image by image; auto: global, and incremental if it fails."""
    max_contradiction_deg: float = 10.0
    """Pairs whose rotation differs more from what the other pairs imply are not used. 180: use all."""
    separate_look_alikes: bool = True
    """If points of a model conflict, map again without the pairs of images that cause it, or clusters of images apart."""
    start_min_inliers: int = 100
    """Matches of the initial pair; reduced if no pair has enough."""
    start_angle_deg: float = 16.0
    """Median triangulation angle of the initial pair beyond which it is not preferred further."""
    start_trials: int = 30
    """Maximum number of initial pairs tried."""
    probe_images: int = 5
    """Number of images of a growing model at which its initial pair is accepted or rejected."""
    min_match_agreement: float = 0.75
    """Fraction of the matches between registered images that must be points of the model at that size."""
    min_final_agreement: float = 0.6
    """The same for a finished model; below it, mapping restarts from other initial pairs."""
    restarts: int = 3
    """Maximum number of restarts from other initial pairs."""
    image_fraction: float = 0.3
    """An image is removed if a smaller fraction of its matches agrees with the model."""
    max_error_px: float = 4.0
    """Observations with a larger reprojection error are removed."""
    min_angle_deg: float = 1.5
    """Points with a smaller triangulation angle are removed, because their depth is unknown."""
    resection_max_error_px: float = 12.0
    """Resection: points with a larger reprojection error are outliers."""
    resection_min_inliers: int = 20
    """Resection: inliers needed to register an image."""
    resection_min_ratio: float = 0.15
    """Resection: fraction of the visible points that must be inliers."""
    min_observations: int = 15
    """An image with fewer observations is removed."""
    local_images: int = 6
    """Local bundle adjustment: images adjusted together after each new one."""
    global_growth: float = 1.25
    """Global bundle adjustment runs each time the model has grown by this factor."""
    completion_px: float = 3.0
    """Points are looked for in further images, within 4 median errors of their projections, but at most this distance."""
    min_track_length: int = 3
    """Points in fewer images are removed from a finished model, if their images have enough others."""
    min_long_tracks: int = 50
    """Number of longer tracks that an image needs to do without the shorter ones."""
    final_rounds: int = 5
    """Maximum number of final rounds of adjusting, filtering and re-triangulating."""
    converged_fraction: float = 5e-4
    """Final rounds end if a smaller fraction of the observations changes."""
    final_loss: Literal["trivial", "huber", "soft_l1", "cauchy"] = "cauchy"
    """Robust loss of the last adjustment; before it, soft L1."""
    loss_scale_px: float = 1.0
    """Scale of the robust loss while the model grows."""
    final_scale: float = 2.0
    """Scale of the robust loss in the last adjustment, as a multiple of the median reprojection error."""
    refine_focal: bool = True
    """Refine focal lengths that are not given."""
    refine_distortion: bool = True
    """Refine distortion that is not given."""
    max_models: int = 10
    """Maximum number of models if the images do not connect."""
    divide_above: int = 20_000
    """More images than this are mapped in parts, which are then joined and adjusted together."""
    part_images: int = 1000
    """Largest number of images of a part, to which a tenth of neighboring ones are added."""
    gps_sigma_m: float = 3.0
    """Standard deviation of GPS positions, which are adjusted with Cauchy's loss."""
    use_gps: bool = True
    """Use GPS positions from EXIF as a robust prior and for the scale."""
    seed: int = 0
    """Seed of random sampling."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        check_options(self)
        for name, value in vars(self).items():
            if isinstance(value, float) and math.isinf(value):
                raise ConfigError(f"{name} must be finite, got {value}")
        for name in ("max_error_px", "resection_max_error_px", "gps_sigma_m"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive, got {getattr(self, name)}")
        check_least(self, divide_above=1, part_images=3)
        if not self.global_growth > 1:
            raise ConfigError(f"global_growth must be greater than 1, got {self.global_growth}")
        if not 0 <= self.seed <= MAX_SEED:
            raise ConfigError(f"seed must be from 0 to {MAX_SEED}, got {self.seed}")


@dataclass(frozen=True, kw_only=True)
class ReconstructConfig:
    """Options of `epipole reconstruct`; the defaults suit most images."""

    camera_model: str | None = None
    """SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL (unless parameters are given), RADIAL, (FULL_)OPENCV, OPENCV_FISHEYE."""
    camera_params: str | None = None
    """Known intrinsics of the camera in COLMAP's order, comma separated; the first pixel's center is (0.5, 0.5)."""
    calibration: Path | None = None
    """Calibration file of the camera, from `epipole calibrate`, OpenCV, ROS or Kalibr."""
    refine_known: bool = False
    """Refine known intrinsics too."""
    rigs: Path | None = None
    """Rigs of cameras, as in COLMAP's rig_config.json: known or constant geometry, and known intrinsics."""
    single_camera: bool = False
    """All images were taken with one camera."""
    include: tuple[str, ...] = ()
    """Use only images whose name, relative to the folder, matches one of these patterns, such as "*.color.jpg"."""
    exclude: tuple[str, ...] = ()
    """Leave out images whose name matches one of these patterns, such as "depth/*"."""
    masks: Path | None = None
    """Folder of masks, MASKS/NAME.png; features in black areas are dropped."""
    pairs: Path | None = None
    """Text file of image pairs to match, two names per line."""
    database: Path | None = None
    """COLMAP database with features and matches to use, and with cameras, unless given here."""
    learned: Path | None = None
    """Folder of learned features (tools/convert_learned_features.py) for images that SIFT connects to few others."""
    learned_network: Literal["xfeat", "aliked"] = "xfeat"
    """aliked: more right matches, several times slower."""
    known_poses: Path | None = None
    """Poses of images that are known approximately, in meters: a COLMAP model, transforms.json or another program's cameras."""
    known_poses_sigma_m: float = 0.05
    """Standard deviation of each coordinate of a known position."""
    known_poses_sigma_deg: float = 1.0
    """Standard deviation of a known rotation about each axis."""
    grow: bool = False
    """Start from the model in OUT, keep its coordinates, and register further images."""
    max_frames: int = 200
    """Maximum number of frames taken from a video."""
    executor: Literal["threads", "processes", "inline"] = "threads"
    """Where images and pairs are processed: threads, processes, or the calling thread (inline)."""
    cluster: str | None = None
    """Process images and pairs on a Dask cluster: tcp://HOST:PORT, tls://HOST:PORT, local:N or slurm:N."""
    shared_folder: bool = True
    """All machines of the cluster see images and output folder under the same paths; otherwise files are sent."""
    threads: int | None = None
    """Number of threads, which does not affect results. None: all processors."""
    seed: int = 0
    """Random seed, added to those of verification and mapper."""
    features: FeatureConfig = field(default_factory=FeatureConfig)
    matching: MatchConfig = field(default_factory=MatchConfig)
    pairing: PairingConfig = field(default_factory=PairingConfig)
    verification: RansacConfig = field(default_factory=lambda: RansacConfig(min_inlier_ratio=0.3))
    mapper: MapperConfig = field(default_factory=MapperConfig)
    anchors: Annotated[AnchorOptions, tyro.conf.arg(name="")] = field(default_factory=AnchorOptions)
    """Measurements besides the images that determine the scale."""

    def __post_init__(self) -> None:
        """Check what does not depend on the images.

        Raises:
            ConfigError: camera parameters are not numbers, options exclude each other, or a value is out of range.
        """
        if isinstance(self.include, str) or isinstance(self.exclude, str):
            raise ConfigError("include and exclude must be tuples of patterns, not one string")
        check_options(self)
        self.known_params()
        if self.calibration is not None and (self.camera_params or self.camera_model):
            raise ConfigError(
                "calibration already has model and parameters: give either it or camera_model and camera_params"
            )
        if self.masks is not None and self.database is not None:
            raise ConfigError("masks cannot be combined with database: its features are already extracted")
        if self.learned is not None and self.database is not None:
            raise ConfigError("learned cannot be combined with database: its features are already extracted")
        if self.rigs is not None and self.database is not None:
            raise ConfigError("rigs cannot be combined with database, whose cameras are given")
        if self.known_poses is not None:
            others = {"grow": self.grow, "rigs": self.rigs, "positions": self.anchors.positions}
            if second := next((name for name, value in others.items() if value), None):
                raise ConfigError(
                    f"known_poses cannot be combined with {second}: both determine coordinates or scale"
                )
        for name in ("known_poses_sigma_m", "known_poses_sigma_deg"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"{name} must be positive and finite, got {getattr(self, name)}")
        if self.cluster is not None:
            from epipole.runs import Cluster  # not needed for --help

            Cluster(self.cluster)
        if self.max_frames < 2:
            raise ConfigError(f"max_frames must be at least 2, got {self.max_frames}")
        if self.threads is not None and self.threads < 1:
            raise ConfigError(f"threads must be at least 1, got {self.threads}")

    def seeded(self) -> ReconstructConfig:
        """Copy with the job's seed added to those of its parts."""
        return replace(
            self,
            verification=replace(self.verification, seed=self.verification.seed + self.seed),
            mapper=replace(self.mapper, seed=self.mapper.seed + self.seed),
        )

    def named_files(self) -> list[Path]:
        """Files given as options."""
        mine = (self.calibration, self.pairs, self.database, self.rigs, self.known_poses)
        anchors = (getattr(self.anchors, name) for name in ANCHOR_FILES)
        return [path for path in (*mine, *anchors) if path is not None]

    @property
    def has_known_camera(self) -> bool:
        """Whether the intrinsics are given, as numbers or as a file."""
        return self.camera_params is not None or self.calibration is not None

    def known_params(self) -> tuple[float, ...] | None:
        """Numbers of `camera_params`; None if not given.

        Raises:
            ConfigError: not finite numbers.
        """
        if self.camera_params is None:
            return None
        from epipole.io.calibration.camera_params import params_of_text  # not needed for --help

        return params_of_text(self.camera_params)
