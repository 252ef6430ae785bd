"""Input and output of SLAM: camera, frames and tracking results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from epipole._checks import check_fields
from epipole.cameras import Camera, CameraModel
from epipole.disparity_search.rectification import Rectification, rectify
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3
from epipole.image.gray import gray_image
from epipole.inertial import MountedImu
from epipole.pipelines.slam.shutter.shutter import Shutter
from epipole.pipelines.slam.tracking.projection import blind_pixels
from epipole.scene import CameraRig, StereoRig


class TrackingState(StrEnum):
    """Tracking state of a frame."""

    STARTING = "starting"
    """One camera: the map is not initialized."""
    TRACKING = "tracking"
    ROTATING = "rotating"
    """One camera, at rest or in pure rotation: the orientation is known, the position is the last known one."""
    LOST = "lost"
    INERTIAL = "inertial"
    """The image shows nothing of the map; for a few seconds the IMU carries the pose, whose covariance grows."""
    SUBMAP = "submap"
    """Tracked in a separate map, started after the camera was lost; the pose in the first map is unknown."""

    @classmethod
    def _missing_(cls, value: object) -> TrackingState | None:
        """The name of a state in files of earlier versions."""
        return cls.ROTATING if value == "turning" else None


@dataclass(frozen=True, slots=True, eq=False)
class DepthCamera:
    """A depth sensor: its intrinsics, pose and unit."""

    camera: Camera
    depth_from_color: Rigid3
    """Identity if the depth is registered to the color image."""
    scale: float = 1.0
    """True meters per reported meter."""


@dataclass(frozen=True, slots=True, eq=False)
class SlamCamera:
    """The tracked camera, with a second camera or a depth sensor if depth is measured; or a rig of cameras."""

    camera: Camera
    baseline: float | None = None
    """Baseline of a rectified pair in meters; the right image has the left one's rows and camera matrix."""
    depth: DepthCamera | None = None
    readout_s: float = 0.0
    """Rolling shutter: seconds from the first row to the one after the last; 0: global shutter."""
    rig: CameraRig | None = None
    """All cameras of a rig, whose poses are those of the rig: `SlamCamera.of_cameras`."""
    left_from_camera: Rigid3 | None = None
    """Of a pair that is rectified: rotation from the rectified camera to the left one that takes the images; else None."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: the baseline or the readout is out of range, there are two sources of depth, or a rig has another one or a
                rolling shutter.
        """
        check_fields(self)
        if self.baseline is not None and not 0 < self.baseline < np.inf:
            raise ConfigError(f"baseline must be positive and finite, got {self.baseline}")
        if self.baseline is not None and self.depth is not None:
            raise ConfigError("pass a baseline or depth, not both")
        if not 0 <= self.readout_s < 1:
            raise ConfigError(f"readout_s must be at least 0 and below 1, got {self.readout_s}")
        if self.rig is not None and (self.measures_disparity or self.readout_s):
            raise ConfigError("a rig cannot be combined with a baseline, a depth sensor or a rolling shutter")
        if self.rig is not None and self.camera is not self.rig.cameras[0]:
            raise ConfigError("the camera is not the rig's first one: use SlamCamera.of_cameras(rig)")

    @staticmethod
    def of_cameras(rig: CameraRig) -> SlamCamera:
        """The camera of frames of `Frame.from_rig`: two to six rigidly mounted cameras, of any models."""
        return SlamCamera(rig.cameras[0], rig=rig)

    @staticmethod
    def of_rig(rig: StereoRig) -> SlamCamera:
        """The camera of frames of `Frame.from_pair`: the rectified pair.

        Raises:
            ConfigError: left and right are swapped.
            DegenerateGeometryError: the pair cannot be rectified to planes.
        """
        found = rectification_of(rig)
        if found is None:
            return SlamCamera(rig.left, rig.baseline)
        flat = found.rig
        params = np.array([flat.focal_px, flat.focal_px, flat.cx, flat.cy])
        rotated = Rigid3(found.rectified_from_left.T.copy(), np.zeros(3))
        return SlamCamera(
            Camera(CameraModel.PINHOLE, *found.size, params), rig.baseline, left_from_camera=rotated
        )

    @property
    def shutter(self) -> Shutter:
        """Times at which rows are read."""
        return Shutter(self.camera, self.readout_s)

    @property
    def is_metric(self) -> bool:
        """Whether lengths are those of the baseline, the depth sensor or the rig."""
        return self.measures_disparity or self.rig is not None

    def with_imu(self, imu: MountedImu) -> MountedImu:
        """An IMU, mounted relative to the camera that takes the images, relative to the tracked camera."""
        if self.left_from_camera is None:
            return imu
        return replace(imu, camera_from_imu=self.left_from_camera.inverse() @ imu.camera_from_imu)

    @property
    def camera_or_rig(self) -> Camera | CameraRig:
        """What the pixels of frames refer to: the camera, or the rig with its stacked image."""
        return self.camera if self.rig is None else self.rig

    @property
    def measures_disparity(self) -> bool:
        """Whether a second camera of a rectified pair or a depth sensor measures depth."""
        return self.depth is not None or self.baseline is not None

    @property
    def measures_depth(self) -> bool:
        """Whether a single frame measures depth."""
        return self.measures_disparity or (self.rig is not None and self.rig.measures_depth)

    def checked(self, frame: Frame, after_s: float = -np.inf) -> Frame:
        """Check that the frame fits this camera and is later than `after_s`; pixels without a ray are masked.

        Raises:
            ShapeError: the images do not have the camera's size.
            ConfigError: the frame is not later, or lacks the right image or depth.
        """
        if frame.timestamp_s <= after_s:
            raise ConfigError(f"timestamps must increase: {frame.timestamp_s:.6f} s after {after_s:.6f} s")
        camera = self.camera_or_rig
        if frame.gray.shape != (camera.height, camera.width):
            size = f"{frame.gray.shape[1]} x {frame.gray.shape[0]}"
            raise ShapeError(f"the image is {size}, but the camera is {camera.width} x {camera.height}")
        if self.baseline is not None and frame.right_gray is None:
            raise ConfigError("a frame of a stereo camera needs a right image")
        self._check_depth(frame)
        blind = blind_pixels(camera)
        if blind is None:
            return frame
        ignored = blind if frame.ignored_mask is None else blind | frame.ignored_mask
        return replace(frame, ignored_mask=ignored)

    def _check_depth(self, frame: Frame) -> None:
        if self.depth is None:
            if frame.depth is not None:
                raise ConfigError(
                    "the frame has depth, but the camera has no depth sensor: pass SlamCamera(camera, depth=...)"
                )
            return
        if frame.depth is None:
            raise ConfigError("a frame of a depth camera needs depth")
        sensor = self.depth.camera
        if frame.depth.shape != (sensor.height, sensor.width):
            size = f"{frame.depth.shape[1]} x {frame.depth.shape[0]}"
            raise ShapeError(
                f"the depth is {size}, but the depth camera is {sensor.width} x {sensor.height} (registered depth has the size"
                " of the image)"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Images taken at the same time."""

    timestamp_s: float
    gray: UInt8[np.ndarray, "h w"]
    right_gray: UInt8[np.ndarray, "h w"] | None = None
    """Right image of a rectified pair."""
    depth: Float32[np.ndarray, "h2 w2"] | None = None
    """Meters along the optical axis, at the depth camera's pixels; zero, NaN or infinite where unknown."""
    ignored_mask: Bool[np.ndarray, "h w"] | None = None
    """True where the (left) image is ignored, such as people or the own vehicle."""

    @staticmethod
    def from_images(
        timestamp_s: float,
        image: Any,
        right: Any = None,
        *,
        depth: Float32[np.ndarray, "h2 w2"] | None = None,
        ignored_mask: Bool[np.ndarray, "h w"] | None = None,
        white: float | None = None,
    ) -> Frame:
        """A frame of gray or color images of any type.

        Args:
            timestamp_s: time.
            image: (left) image, as for `epipole.image.gray_image`.
            right: right image of a rectified pair.
            depth: meters along the optical axis.
            ignored_mask: True where the image is ignored.
            white: value of white; None: the largest of the type, or 1.0 for floating point.

        Raises:
            ShapeError: the images are of another kind, or their sizes do not match.
            ConfigError: the timestamp is not finite, or values are out of range.
        """
        gray, other = gray_image(image, white), None if right is None else gray_image(right, white)
        return Frame(timestamp_s, gray, other, depth, ignored_mask)

    @staticmethod
    def from_pair(
        timestamp_s: float, left: Any, right: Any, rig: StereoRig, white: float | None = None
    ) -> Frame:
        """A frame of a raw pair, which is rectified; its camera is `SlamCamera.of_rig(rig)`.

        The lookup tables are kept for the last rigs: pass the same object each time.

        Args:
            timestamp_s: time.
            left: image of the left camera, as for `epipole.image.gray_image`.
            right: image of the right camera.
            rig: both cameras, of any models.
            white: as for `from_images`.

        Raises:
            ShapeError: the images are of another kind, or do not have the cameras' sizes.
            ConfigError: left and right are swapped, the timestamp is not finite, or values are out of range.
            DegenerateGeometryError: the pair cannot be rectified to planes.
        """
        images = gray_image(left, white), gray_image(right, white)
        for side, image, camera in zip(("left", "right"), images, (rig.left, rig.right)):
            require_size(f"{side} image", image, camera)
        found = rectification_of(rig)
        return Frame(timestamp_s, *(images if found is None else found.apply(*images)))

    @staticmethod
    def from_rig(
        timestamp_s: float,
        images: Sequence[Any],
        rig: CameraRig,
        ignored_masks: Sequence[np.ndarray | None] | None = None,
        white: float | None = None,
    ) -> Frame:
        """A frame of a rig; its camera is `SlamCamera.of_cameras(rig)`.

        Args:
            timestamp_s: time of all images.
            images: one per camera, as for `epipole.image.gray_image`.
            rig: the cameras.
            ignored_masks: one mask per camera (None: nothing), True where the image is ignored.
            white: as for `from_images`.

        Raises:
            ShapeError: the images are of another kind, not one per camera, or do not have the cameras' sizes.
            ConfigError: the timestamp is not finite, or values are out of range.
        """
        gray = rig.stack([gray_image(image, white) for image in images])
        mask = None
        if ignored_masks is not None:
            mask = stacked_mask(rig, ignored_masks)
        return Frame(timestamp_s, gray, ignored_mask=mask)

    def is_used(self, pixels: Float64[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """Whether pixels are outside `ignored_mask`."""
        return is_outside(self.ignored_mask, pixels)

    def __post_init__(self) -> None:
        """Check the images.

        Raises:
            ShapeError: their sizes or types do not match.
            ConfigError: the timestamp is not finite.
        """
        if isinstance(self.depth, np.ndarray) and self.depth.dtype.kind in "iu":
            raise ShapeError(
                f"depth must be float32 in meters, got {self.depth.dtype}: convert millimeters with"
                " depth.astype(np.float32) / 1000"
            )
        try:
            check_fields(self)
        except ShapeError as error:
            raise ShapeError(
                f"the images of a frame must have the same size, gray 8 bits and depth float32 ({error})"
            ) from None
        if not np.isfinite(self.timestamp_s):
            raise ConfigError(f"timestamp_s must be finite, got {self.timestamp_s}")


@lru_cache(maxsize=4)
def rectification_of(rig: StereoRig) -> Rectification | None:
    """How a pair is rectified; None if it is rectified already."""
    is_flat = (
        rig.left.model == rig.right.model == CameraModel.PINHOLE
        and np.array_equal(rig.left.params, rig.right.params)
        and np.abs(rig.right_from_left.rotation - np.eye(3)).max() < 1e-9
        and np.abs(rig.right_from_left.translation[1:]).max() < 1e-9 * rig.baseline
    )
    return None if is_flat else rectify(rig)


def stacked_mask(rig: CameraRig, masks: Sequence[np.ndarray | None]) -> np.ndarray:
    """The masks of a rig's cameras, of which None masks nothing, in the stacked image.

    Raises:
        ShapeError: there is not one mask per camera, or one does not have its camera's size.
    """
    if len(masks) != len(rig.cameras):
        raise ShapeError(f"a rig of {len(rig.cameras)} cameras needs as many masks, got {len(masks)}")
    out = np.zeros((rig.height, rig.width), bool)
    for k, (part, mask) in enumerate(zip(rig.parts(out), masks)):
        if mask is not None and mask.shape != part.shape:
            raise ShapeError(f"the mask of camera {k} has the shape {mask.shape}, but the image {part.shape}")
        part[:] = False if mask is None else mask
    return out


def require_size(what: str, image: np.ndarray, camera: Camera) -> None:
    """Check the size, since lookup tables would read wrong pixels in an image of another size.

    Raises:
        ShapeError: the image does not have the camera's size.
    """
    if image.shape != (camera.height, camera.width):
        size = f"{image.shape[1]} x {image.shape[0]}"
        raise ShapeError(f"the {what} is {size}, but its camera is {camera.width} x {camera.height}")


def is_outside(mask: np.ndarray | None, pixels: np.ndarray) -> np.ndarray:
    """(n,) whether pixels are outside a mask (h, w); None masks nothing."""
    if mask is None:
        return np.ones(len(pixels), bool)
    height, width = mask.shape
    column, row = np.rint(pixels).astype(int).T
    return ~mask[row.clip(0, height - 1), column.clip(0, width - 1)]


@dataclass(frozen=True, slots=True, eq=False)
class MovingThing:
    """Map points that moved together since the last keyframe, differently from the scene."""

    num_points: int
    low_px: tuple[float, float]
    """Left and top of the rectangle that contains nearly all points."""
    high_px: tuple[float, float]
    """Right and bottom of the rectangle."""
    motion: Float64[np.ndarray, " 3"]
    """Motion of the center, in the map's world and unit; NaN if one camera cannot determine it."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """Tracking result, as estimated when the frame arrived."""

    timestamp_s: float
    state: TrackingState
    reason: str
    """Why there is no pose, why the frame is a keyframe, or a warning; empty if there is nothing to report."""
    world_from_body: Rigid3 | None
    """None if the pose is unknown."""
    covariance: Float64[np.ndarray, "6 6"] | None
    """Covariance of xi = (translation, rotation) in body_from_world = exp(xi) @ the estimate."""
    num_points: int
    """Number of inlier map points."""
    is_keyframe: bool
    submap_from_body: Rigid3 | None = None
    """Pose in the separate map that the camera is tracked in; None in the first map."""
    moving: MovingThing | None = None
    """A moving object."""
    map_number: int = 0
    """Number of the map that the pose refers to, in order of initialization."""

    @property
    def has_pose(self) -> bool:
        """Whether the pose is known in one of the maps."""
        return self.world_from_body is not None or self.submap_from_body is not None

    def with_words(self, words: str) -> TrackedFrame:
        """The same frame with words appended to the reason."""
        return replace(self, reason=f"{self.reason}; {words}" if self.reason else words)

    def __repr__(self) -> str:
        return f"TrackedFrame({self.timestamp_s:.3f} s, {self.state.value}, {self.num_points} points)"
