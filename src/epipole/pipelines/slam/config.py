"""Options of SLAM."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from epipole._checks import check_least, check_options
from epipole.config import AnchorOptions, FlowConfig
from epipole.errors import ConfigError

if TYPE_CHECKING:
    from epipole.cameras import Camera
    from epipole.cameras.image_fit import ImageShape
    from epipole.scene import StereoRig


@dataclass(frozen=True, kw_only=True)
class OdometryConfig(FlowConfig):
    """Options of tracking and mapping."""

    num_features: int = 400
    """Number of points tracked at a time."""
    min_distance_px: int = 12
    """Minimum distance between new points, in pixels."""
    corner_quality: float = 0.02
    """Minimum strength of a corner, relative to the strongest corner of the image."""
    max_error_px: float = 3.0
    """Maximum reprojection error of an inlier, in pixels."""
    min_tracked: int = 15
    """Number of inliers below which the camera is lost."""
    keyframe_fraction: float = 0.65
    """Insert a keyframe when fewer than this fraction of the last keyframe's points are inliers."""
    keyframe_motion: float = 0.04
    """Insert a keyframe when the points have moved by this fraction of the image width."""
    keyframe_rotation: bool = True
    """Count motion by rotation, too. False (depth, no IMU): only parallax counts; a rolling shutter may not be detected."""
    keyframe_points: int = 150
    """Insert a keyframe when fewer than this many triangulated points are inliers."""
    keyframe_gap: int = 20
    """Insert a keyframe after this many frames at the latest."""
    min_angle_deg: float = 0.5
    """Minimum triangulation angle, in degrees."""
    triangulation_angle_deg: float = 1.0
    """Minimum angle to triangulate between a keyframe and an ordinary frame, in degrees."""
    start_angle_deg: float = 1.0
    """One camera: minimum median triangulation angle to initialize the map, in degrees."""
    lost_patience: int = 3
    """Number of frames without a pose after which a separate map is started."""
    window: int = 20
    """Keyframes in local bundle adjustment (twice as many with one camera)."""
    max_fixed: int = 12
    """Maximum number of additional fixed keyframes in local bundle adjustment."""
    depth_sigma_px: float = 1.0
    """Standard deviation of disparities, measured or converted from sensor depth, in pixels."""
    sensor_baseline_m: float = 0.08
    """Depth sensor: baseline of a stereo pair whose depth errors grow alike, in meters."""
    focal_sigma: float | None = None
    """Relative standard deviation of the focal length (None: 0.003 for stereo, 0.01 for depth sensors)."""
    center_sigma_px: float | None = None
    """Standard deviation of the principal point, in pixels (None: 1 for stereo, 3 for depth sensors)."""
    depth_sigma: float | None = None
    """Relative standard deviation of baseline or depth (None: 0.003 for stereo, 0.015 for depth sensors)."""
    max_depth_baselines: float = 120.0
    """Maximum distance for depth from a single frame, in baselines."""
    seed: int = 0
    """Random seed."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        FlowConfig.__post_init__(self)
        check_least(self, num_features=50, min_distance_px=2, window=2, max_fixed=1)
        for name in ("max_error_px", "depth_sigma_px", "sensor_baseline_m", "max_depth_baselines"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"{name} must be positive and finite, got {getattr(self, name)}")
        for name in ("focal_sigma", "center_sigma_px", "depth_sigma"):
            value = getattr(self, name)
            limit = 100 if name == "center_sigma_px" else 1
            if value is not None and not 0 <= value < limit:
                raise ConfigError(f"{name} must be at least 0 and below {limit}, got {value}")
        if not 0 < self.start_angle_deg < 45:
            raise ConfigError(f"start_angle_deg must be positive and below 45, got {self.start_angle_deg}")
        if not 0 < self.min_angle_deg <= self.start_angle_deg:
            raise ConfigError(
                f"min_angle_deg must be positive and at most start_angle_deg, got {self.min_angle_deg} and"
                f" {self.start_angle_deg}"
            )


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """Options of the camera, for sources without a calibration."""

    camera_model: str | None = None
    """SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV or OPENCV_FISHEYE (None: PINHOLE)."""
    camera_params: str | None = None
    """Comma-separated intrinsics in COLMAP's order, such as 525,525,320,240 (fx,fy,cx,cy); cx,cy: OpenCV's plus 0.5."""
    calibration: Path | None = None
    """Calibration file of epipole, OpenCV, ROS or Kalibr, or folder with left.yaml, right.yaml."""
    readout_s: float = 0.0
    """Rolling shutter: seconds from the first row to the one after the last; 0: global shutter."""
    depth_scale: float | None = None
    """Depth images: stored values per meter, such as 1000 or 5000 (None: from the source)."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_options(self)
        if self.depth_scale is not None and not 0 < self.depth_scale < 1e6:
            raise ConfigError(f"depth_scale must be positive and below a million, got {self.depth_scale}")
        if not 0 <= self.readout_s < 1:
            raise ConfigError(f"readout_s must be at least 0 and below 1, got {self.readout_s}")

    def camera(self, size: tuple[int, int]) -> Camera | None:
        """The camera for images of this size without EXIF orientation; None if no intrinsics are given.

        Raises:
            ConfigError: the parameters do not fit the model, or the calibration does not fit the images.
            FileFormatError: the calibration cannot be read.
        """
        from epipole.cameras.image_fit import ImageShape

        found = self.fitted_camera(ImageShape(*size))
        return None if found is None else found[0]

    def fitted_camera(self, shape: ImageShape) -> tuple[Camera, list[str]] | None:
        """The camera for upright images of this shape, and notes on the fit; None if no intrinsics are given.

        Raises:
            ConfigError: the parameters do not fit the model, or the calibration does not fit the images.
            FileFormatError: the calibration cannot be read.
        """
        from epipole.cameras.image_fit import (
            ImagePixels,
            camera_of_image,
            described_pixels,
            fit_notes,
            with_likely_principal_point,
        )
        from epipole.io.calibration.camera_params import camera_of_calibration, camera_of_images

        if self.calibration is not None:
            if self.camera_params or self.camera_model:
                raise ConfigError("calibration is given: omit camera_model and camera_params")
            what = f"calibration {self.calibration}"
            found = camera_of_calibration(self.calibration, shape.size(ImagePixels.STORED))
        elif self.camera_params is not None:
            what = "the camera of camera_params"
            found = camera_of_images(self.camera_model, [shape], self.camera_params)
        else:
            return None
        described = described_pixels((found.width, found.height), [shape], what)
        found, odd = with_likely_principal_point(found)
        notes = [*fit_notes(found, [shape], described, what), *([odd] if odd else [])]
        return camera_of_image(found, shape, described), notes

    def rig(self, size: tuple[int, int]) -> StereoRig | None:
        """The stereo rig for images of this size; None if no calibration is given.

        Raises:
            ConfigError: camera_params are given, which describe one camera, or the calibration does not fit the images.
            FileFormatError: the calibration cannot be read, or is not of two cameras.
        """
        if self.camera_params is not None:
            raise ConfigError("camera_params describe one camera: pass a calibration of both")
        if self.calibration is None:
            return None
        from epipole.io.calibration.files import read_stereo_rig

        return read_stereo_rig(self.calibration, size=size).scaled_to(size, size)


@dataclass(frozen=True, kw_only=True)
class JobOptions:
    """Options of input and output."""

    sensor: Literal["auto", "mono", "stereo", "rgbd", "rig"] = "auto"
    """Sensor to use; auto: depth, else a second camera, if there is one; rig: folders cam0, cam1, ... or a bag, and a calibration."""
    topics: str | None = None
    """ROS bags: image topic; LEFT,RIGHT; IMAGES,DEPTH; or one per camera of a rig (None: found by type and name)."""
    start: int = 0
    """Number of frames to skip at the start."""
    stride: int = 1
    """Track every N-th frame."""
    max_frames: int | None = None
    """Maximum number of frames to track."""
    fps: float | None = None
    """Frame rate of image folders without timestamps (None: 30)."""
    masks: Path | None = None
    """Folder of masks MASKS/NAME.png for image folders; points on black pixels are ignored."""
    realtime: bool = False
    """Replay in real time: drop frames that pass while another one is tracked."""
    mapping: Literal["auto", "inline", "thread"] = "auto"
    """Adjust the map in the frame of a keyframe (inline), or in a thread, so that no frame waits and results depend on the
    machine; auto: in a thread for live cameras and with realtime."""
    trajectory_format: Literal["tum", "kitti", "euroc"] = "tum"
    """Also write the trajectories in this format."""
    record: Path | None = None
    """Also record poses, map and images to this file (.mcap) for Foxglove, RViz and other tools of ROS (pip install
    'epipole[ros]')."""
    mesh: bool = False
    """Depth sensors and stereo: also write a mesh of the keyframes' depth, mesh.ply."""
    map: tuple[Path, ...] = ()
    """Continue in the map of an earlier run (its output folder); repeated: in several maps, merged where possible."""
    localize: bool = False
    """Only localize the camera in that map, which does not change."""
    anchors: Annotated[AnchorOptions, tyro.conf.arg(name="")] = field(default_factory=AnchorOptions)
    """One camera: measurements that determine the scale."""
    truth: Path | None = None
    """True trajectory for error statistics: a TUM, KITTI or EuRoC file, or a 7-Scenes, TUM RGB-D or KITTI folder."""
    resume: bool = False
    """Continue the stopped run of the output folder, or restart it if its frames can be read again."""
    view: bool = False
    """Show trajectory, map and image in the browser, until Ctrl-C."""
    port: int | None = None
    """Port of the live view (None: 8080 or the next free one)."""
    host: str = "127.0.0.1"
    """Address of the live view; 0.0.0.0 accepts other machines."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_options(self)
        if self.max_frames is not None and self.max_frames < 1:
            raise ConfigError(f"max_frames must be at least 1, got {self.max_frames}")
        if self.start < 0 or self.stride < 1:
            raise ConfigError(f"start must be >= 0 and stride >= 1, got {self.start} and {self.stride}")
        if self.fps is not None and not 0 < self.fps < 1e6:
            raise ConfigError(f"fps must be positive, got {self.fps}")
        if self.localize and not self.map:
            raise ConfigError("localize needs a map: pass map")
        if self.port is not None and not self.view:
            raise ConfigError("port belongs to the live view: pass view")

    @property
    def topic_names(self) -> tuple[str, ...]:
        """The requested topics; empty if they are found automatically."""
        return tuple((self.topics or "").replace(",", " ").split())


@dataclass(frozen=True, kw_only=True)
class SlamConfig(OdometryConfig, CameraOptions, JobOptions):
    """Options of `slam`: frames, camera, tracking and mapping."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        for part in (JobOptions, CameraOptions, OdometryConfig):
            part.__post_init__(self)

    @property
    def odometry(self) -> OdometryConfig:
        """The options of tracking and mapping."""
        return OdometryConfig(**{each.name: getattr(self, each.name) for each in fields(OdometryConfig)})
