"""Options that the jobs take by keyword, for editors and type checkers. Written by `tests/option_types.py`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, TypedDict

from epipole.config import AnchorOptions


class SlamKeywords(TypedDict, total=False):
    """Fields of `SlamConfig`, each optional."""

    sensor: Literal["auto", "mono", "stereo", "rgbd", "rig"]
    topics: str | None
    start: int
    stride: int
    max_frames: int | None
    fps: float | None
    masks: str | Path | None
    realtime: bool
    mapping: Literal["auto", "inline", "thread"]
    trajectory_format: Literal["tum", "kitti", "euroc"]
    record: str | Path | None
    mesh: bool
    map: str | Path | tuple[str | Path, ...]
    localize: bool
    anchors: AnchorOptions
    truth: str | Path | None
    resume: bool
    view: bool
    port: int | None
    host: str
    camera_model: str | None
    camera_params: str | None
    calibration: str | Path | None
    readout_s: float
    depth_scale: float | None
    window_px: int
    levels: int
    max_return_px: float
    min_eigenvalue: float
    num_features: int
    min_distance_px: int
    corner_quality: float
    max_error_px: float
    min_tracked: int
    keyframe_fraction: float
    keyframe_motion: float
    keyframe_rotation: bool
    keyframe_points: int
    keyframe_gap: int
    min_angle_deg: float
    triangulation_angle_deg: float
    start_angle_deg: float
    lost_patience: int
    window: int
    max_fixed: int
    depth_sigma_px: float
    sensor_baseline_m: float
    focal_sigma: float | None
    center_sigma_px: float | None
    depth_sigma: float | None
    max_depth_baselines: float
    seed: int
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
