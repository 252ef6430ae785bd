"""Options of SLAM."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from epipole._declared import check_options
from epipole.config import AnchorOptions, FlowConfig
from epipole.errors import ConfigError

if TYPE_CHECKING:
    from epipole.cameras import Camera
    from epipole.cameras.image_fit import ImageShape
    from epipole.scene import StereoRig


@dataclass(frozen=True, kw_only=True)
class OdometryConfig(FlowConfig):
    """Options of `Slam`. A new user needs none."""

    num_features: int = 400
    """Points followed at a time."""
    min_distance_px: int = 12
    """Between points, at their begin."""
    corner_quality: float = 0.02
    """Corners weaker than this share of the image's strongest are not taken."""
    max_error_px: float = 3.0
    """Points further from where the map says are mistakes."""
    min_tracked: int = 15
    """With fewer points of the map in agreement the camera is lost."""
    keyframe_fraction: float = 0.65
    """A new keyframe is made when fewer of the last one's points are in sight."""
    keyframe_motion: float = 0.04
    """... or when points have moved by more than this share of the image's width."""
    keyframe_points: int = 150
    """... or when fewer than this many points with a place are followed."""
    keyframe_gap: int = 20
    """... or after so many frames."""
    min_angle_deg: float = 0.5
    """Two rays that meet under a narrower angle give no point."""
    triangulation_angle_deg: float = 1.0
    """... and under a wider one than this a point that only one keyframe has seen gets its place from a frame between."""
    start_angle_deg: float = 1.0
    """One camera: median angle of the rays at which the map begins."""
    lost_patience: int = 3
    """Frames without a place after which a map of its own begins."""
    window: int = 20
    """Keyframes adjusted together after each new one; of one camera twice as many."""
    max_fixed: int = 12
    """Further keyframes that hold the window in its place."""
    depth_sigma_px: float = 1.0
    """Standard deviation of disparities, measured or made of a sensor's depth."""
    sensor_baseline_m: float = 0.08
    """Depth sensor: the baseline that its errors grow as of."""
    focal_sigma: float | None = None
    """Relative standard deviation of the calibrated focal length, for the covariances (None: 0.003 for stereo, 0.01 for depth sensors)."""
    center_sigma_px: float | None = None
    """Standard deviation of the principal point, in pixels (None: 1 for stereo, 3 for depth sensors)."""
    depth_sigma: float | None = None
    """Relative standard deviation of the baseline or of measured depth (None: 0.003 for stereo, 0.015 for depth sensors)."""
    max_depth_baselines: float = 120.0
    """Points that are further than so many baselines get no depth from a single frame."""
    seed: int = 0
    """Of all that is drawn at random: the same seed, the same path."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        FlowConfig.__post_init__(self)
        if self.num_features < 50 or self.min_distance_px < 2 or self.window < 2 or self.max_fixed < 1:
            raise ConfigError(
                "num_features must be at least 50, min_distance_px and window at least 2, max_fixed at least 1"
            )
        for name in ("max_error_px", "depth_sigma_px", "sensor_baseline_m", "max_depth_baselines"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"{name} must be positive and finite, got {getattr(self, name)}")
        for name in ("focal_sigma", "center_sigma_px", "depth_sigma"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < (100 if name == "center_sigma_px" else 1):
                raise ConfigError(
                    f"{name} must not be negative, nor as large as the value itself, got {value}"
                )
        if not 0 < self.min_angle_deg <= self.start_angle_deg < 45:
            raise ConfigError("min_angle_deg and start_angle_deg must be positive, the second not smaller")


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """What is known of the camera, for folders that do not tell it."""

    camera_model: str | None = None
    """SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV or OPENCV_FISHEYE (PINHOLE unless given)."""
    camera_params: str | None = None
    """Intrinsics, comma separated, in COLMAP's order, such as 525,525,320,240 (fx,fy,cx,cy): the principal point counts
    from the image's corner, half a pixel more than from the first pixel's centre (OpenCV, ROS)."""
    calibration: Path | None = None
    """Calibration file, as `epipole calibrate` writes it (OpenCV's, ROS' and Kalibr's too)."""
    readout_s: float = 0.0
    """Of a rolling shutter: seconds from the first row to the one after the last; 0: all rows at once."""
    depth_scale: float | None = None
    """Depth images: stored values for a metre, such as 1000 or 5000 (what the files and the layout say unless given)."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_options(self)
        if self.depth_scale is not None and not 0 < self.depth_scale < 1e6:
            raise ConfigError(f"depth_scale must be positive and below a million, got {self.depth_scale}")
        if not 0 <= self.readout_s < 1:
            raise ConfigError(f"readout_s must be from 0 to below 1, got {self.readout_s}")

    def camera(self, size: tuple[int, int]) -> Camera | None:
        """The camera for images of this size, that are not turned; None where nothing is given.

        Raises:
            ConfigError: the parameters are not those of the model, or the calibration does not fit the images.
            FileFormatError: the calibration cannot be read.
        """
        from epipole.cameras.image_fit import ImageShape

        found = self.fitted_camera(ImageShape(*size))
        return None if found is None else found[0]

    def fitted_camera(self, shape: ImageShape) -> tuple[Camera, list[str]] | None:
        """The camera of upright images of this shape, and how it was fitted to them; None where nothing is given.

        Raises:
            ConfigError: the parameters are not those of the model, or the calibration does not fit the images.
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
                raise ConfigError("calibration tells model and parameters: give it, or camera_params")
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
        """The pair of cameras for images of this size; None where no calibration is given.

        Raises:
            ConfigError: camera_params, which are of one camera, are given.
            ConfigError: the calibration does not fit the images.
            FileFormatError: the calibration cannot be read, or is not of two cameras.
        """
        if self.camera_params is not None:
            raise ConfigError("camera_params are of one camera: give a calibration of both")
        if self.calibration is None:
            return None
        from epipole.io.calibration.files import read_stereo_rig

        return read_stereo_rig(self.calibration, size=size).scaled_to(size, size)


@dataclass(frozen=True, kw_only=True)
class JobOptions:
    """What the job takes of its source, how, and what it writes and shows."""

    sensor: Literal["auto", "mono", "stereo", "rgbd"] = "auto"
    """What to use; auto takes depth, else a second camera, where there is one."""
    topics: str | None = None
    """Recordings of ROS: the topic of the images; LEFT,RIGHT; or PICTURES,DEPTH (found by type and name unless given)."""
    start: int = 0
    """First frame to follow: so many of the source before it are left out."""
    stride: int = 1
    """Follow every so-many-th frame from there on."""
    max_frames: int | None = None
    """Frames to follow at most."""
    fps: float | None = None
    """Folders of images without times: frames a second (30 unless given)."""
    masks: Path | None = None
    """Folder of masks for a folder of images: MASKS/NAME.png; points where the mask is black are not used."""
    realtime: bool = False
    """Take frames as a camera gives them: those whose time passes while another is followed are dropped, and counted."""
    trajectory_format: Literal["tum", "kitti", "euroc"] = "tum"
    """Write the paths in this form, too, beside TUM's."""
    map: Path | None = None
    """Go on in the map of an earlier run (its output folder): the camera is found in it, and the map grows."""
    localize: bool = False
    """Only find the camera in that map, which stays as it is."""
    anchors: Annotated[AnchorOptions, tyro.conf.arg(name="")] = field(default_factory=AnchorOptions)
    """One camera: what fixes its scale."""
    truth: Path | None = None
    """The true path, for errors in the summary and the report: a trajectory (TUM, KITTI or EuRoC), or a folder that
    brings one (7-Scenes, TUM RGB-D, KITTI)."""
    resume: bool = False
    """Continue the run that was stopped in the output folder; one whose frames can be read again is started again."""
    view: bool = False
    """Show path, map and image in the browser while it runs, and after it until Ctrl-C."""
    port: int | None = None
    """Of the live view; None: 8080, or the next free one."""
    host: str = "127.0.0.1"
    """Address of the live view; 0.0.0.0 lets other machines in."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_options(self)
        if self.max_frames is not None and self.max_frames < 1:
            raise ConfigError(f"max_frames must be at least 1, got {self.max_frames}")
        if self.start < 0 or self.stride < 1:
            raise ConfigError(f"start must be at least 0 and stride 1, got {self.start} and {self.stride}")
        if self.fps is not None and not 0 < self.fps < 1e6:
            raise ConfigError(f"fps must be positive, got {self.fps}")
        if self.localize and self.map is None:
            raise ConfigError("localize finds the camera in a map: give it, too (map)")
        if self.port is not None and not self.view:
            raise ConfigError("port is that of the live view: it needs view")

    @property
    def topic_names(self) -> tuple[str, ...]:
        """The topics asked for; empty where they are to be found."""
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
        """The part that tracking and mapping depend on."""
        return OdometryConfig(**{each.name: getattr(self, each.name) for each in fields(OdometryConfig)})
