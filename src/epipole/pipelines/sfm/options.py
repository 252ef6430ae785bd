"""Options that the jobs take by keyword, for editors and type checkers. Written by `tests/option_types.py`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, TypedDict

from epipole.config import AnchorOptions, FeatureConfig, MatchConfig, RansacConfig
from epipole.pipelines.sfm.config import MapperConfig, PairingConfig


class ReconstructKeywords(TypedDict, total=False):
    """Fields of `ReconstructConfig`, each optional."""

    camera_model: str | None
    camera_params: str | None
    calibration: str | Path | None
    refine_known: bool
    rigs: str | Path | None
    single_camera: bool
    include: tuple[str, ...]
    exclude: tuple[str, ...]
    masks: str | Path | None
    pairs: str | Path | None
    database: str | Path | None
    learned: str | Path | None
    learned_network: Literal["xfeat", "aliked"]
    known_poses: str | Path | None
    known_poses_sigma_m: float
    known_poses_sigma_deg: float
    grow: bool
    max_frames: int
    cluster: str | None
    shared_folder: bool
    threads: int | None
    seed: int
    features: FeatureConfig
    matching: MatchConfig
    pairing: PairingConfig
    verification: RansacConfig
    mapper: MapperConfig
    anchors: AnchorOptions
    kind: Literal["sift", "orb"]
    max_features: int
    max_size_px: int
    contrast_threshold: float
    domain_sizes: int
    max_ratio: float
    max_distance: float
    max_bits: int
    preemptive_features: int
    preemptive_min_matches: int
    exhaustive_limit: int
    neighbors: int
    first_neighbors: int
    expansion: int
    overlap: int
    confidence: float
    min_iterations: int
    max_iterations: int
    min_inliers: int | None
    min_inlier_ratio: float
    max_contradiction_deg: float
    separate_look_alikes: bool
    start_min_inliers: int
    start_angle_deg: float
    start_trials: int
    probe_images: int
    min_match_agreement: float
    min_final_agreement: float
    restarts: int
    image_fraction: float
    min_angle_deg: float
    resection_max_error_px: float
    resection_min_inliers: int
    resection_min_ratio: float
    min_observations: int
    local_images: int
    global_growth: float
    completion_px: float
    min_track_length: int
    min_long_tracks: int
    final_rounds: int
    converged_fraction: float
    final_loss: Literal["trivial", "huber", "soft_l1", "cauchy"]
    loss_scale_px: float
    final_scale: float
    refine_focal: bool
    refine_distortion: bool
    max_models: int
    divide_above: int
    part_images: int
    gps_sigma_m: float
    use_gps: bool
    positions: str | Path | None
    positions_sigma_m: float
    lengths: str | Path | None
    lengths_sigma_m: float
    clicks_sigma_px: float
    tag_size_m: float | None
    tag_family: str
    board: str | None
    square_m: float | None
    size_sigma: float
    odometry: str | Path | None
    odometry_sigma: float
    odometry_mounting: str | Path | None
    imu: str | Path | None
    imu_mounting: str | Path | None
    imu_units: str
    imu_topic: str
