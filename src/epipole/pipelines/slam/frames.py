"""What goes into SLAM, and what comes out, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from epipole._declared import check_fields
from epipole.cameras import Camera
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3
from epipole.image.pixels_without_ray import pixels_without_ray


class TrackingState(StrEnum):
    """What is known of the camera in a frame."""

    STARTING = "starting"
    """One camera: the map has not begun."""
    TRACKING = "tracking"
    ROTATING = "turning"
    """One camera that turns on the spot, or rests: its orientation is known, its place is the last known one."""
    LOST = "lost"
    SUBMAP = "submap"
    """Followed in a map of its own, begun after the camera was lost; its place in the first map is not known."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthCamera:
    """A depth sensor beside the camera: its lens, its place, and its unit."""

    camera: Camera
    depth_from_color: Rigid3
    """Identity for depth that was registered to the colour image already."""
    scale: float = 1.0
    """Metres for each metre that it reports."""


@dataclass(frozen=True, slots=True, eq=False)
class SlamCamera:
    """The camera whose path is followed, and what tells depth besides: a second camera, or a depth sensor."""

    camera: Camera
    baseline: float | None = None
    """Of a rectified pair, in metres; the right image has the left one's rows and camera matrix."""
    depth: DepthCamera | None = None
    readout_s: float = 0.0
    """Of a rolling shutter: from the first row to the one after the last; 0: all rows at once."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: the baseline is not positive, the readout negative, or there are two sources of depth.
        """
        check_fields(self)
        if self.baseline is not None and not 0 < self.baseline < np.inf:
            raise ConfigError(f"baseline must be positive and finite, got {self.baseline}")
        if self.baseline is not None and self.depth is not None:
            raise ConfigError("give a baseline or depth, not both")
        if not 0 <= self.readout_s < 1:
            raise ConfigError(f"readout_s must be from 0 to below 1, got {self.readout_s}")

    @property
    def measures_depth(self) -> bool:
        """Whether a single frame has depth."""
        return self.depth is not None or self.baseline is not None

    def checked(self, frame: Frame, after_s: float = -np.inf) -> Frame:
        """The frame, without the pixels that have no ray, once it is known to be this camera's and later than `after_s`.

        Raises:
            ShapeError: the images are not of the camera's size.
            ConfigError: the frame is not later, or lacks what tells depth.
        """
        if frame.timestamp_s <= after_s:
            raise ConfigError(f"a frame of {frame.timestamp_s:.6f} s comes after one of {after_s:.6f} s")
        camera = self.camera
        if frame.grey.shape != (camera.height, camera.width):
            size = f"{frame.grey.shape[1]} x {frame.grey.shape[0]}"
            raise ShapeError(f"the image is {size}, the camera's {camera.width} x {camera.height}")
        if self.baseline is not None and frame.right_grey is None:
            raise ConfigError("a frame of a stereo camera needs its right image")
        self._check_depth(frame)
        blind = pixels_without_ray(camera)
        if blind is None:
            return frame
        ignored = blind if frame.ignored_mask is None else blind | frame.ignored_mask
        return replace(frame, ignored_mask=ignored)

    def _check_depth(self, frame: Frame) -> None:
        if self.depth is None:
            if frame.depth is not None:
                raise ConfigError(
                    "the frame has depth, and the camera nothing that tells it: SlamCamera(lens, depth=...)"
                )
            return
        if frame.depth is None:
            raise ConfigError("a frame of a depth camera needs its depth")
        sensor = self.depth.camera
        if frame.depth.shape != (sensor.height, sensor.width):
            size = f"{frame.depth.shape[1]} x {frame.depth.shape[0]}"
            raise ShapeError(
                f"the depth is {size}, the depth camera's {sensor.width} x {sensor.height} (depth that is registered to the"
                " image has its size)"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Images of one instant."""

    timestamp_s: float
    grey: UInt8[np.ndarray, "h w"]
    right_grey: UInt8[np.ndarray, "h w"] | None = None
    """Of a rectified pair."""
    depth: Float32[np.ndarray, "h2 w2"] | None = None
    """Metres along the optical axis, at the depth camera's pixels; zero, NaN or infinite where not known."""
    ignored_mask: Bool[np.ndarray, "h w"] | None = None
    """True where the (left) image is not to be used: people, the vehicle itself."""

    def is_used(self, pixels: Float64[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """Which places in the image are to be used."""
        return is_outside(self.ignored_mask, pixels)

    def __post_init__(self) -> None:
        """Check the images.

        Raises:
            ShapeError: they are not of one size or kind.
            ConfigError: the time is no number.
        """
        if isinstance(self.depth, np.ndarray) and self.depth.dtype.kind in "iu":
            raise ShapeError(
                f"depth must be float32 in metres, got {self.depth.dtype}: sensors that count millimetres need"
                " depth.astype(np.float32) / 1000"
            )
        try:
            check_fields(self)
        except ShapeError as error:
            raise ShapeError(
                f"a frame's images must be of one size, grey of 8 bits, depth float32: {error}"
            ) from None
        if not np.isfinite(self.timestamp_s):
            raise ConfigError(f"timestamp_s must be finite, got {self.timestamp_s}")


def is_outside(mask: np.ndarray | None, pixels: np.ndarray) -> np.ndarray:
    """(n,) which pixels are not under a mask (h, w); None is none."""
    if mask is None:
        return np.ones(len(pixels), bool)
    height, width = mask.shape
    column, row = np.rint(pixels).astype(int).T
    return ~mask[row.clip(0, height - 1), column.clip(0, width - 1)]


@dataclass(frozen=True, slots=True, eq=False)
class MovingThing:
    """Points of the map that moved together since the last keyframe, and otherwise than the scene."""

    num_points: int
    low_px: tuple[float, float]
    """Left and top of the rectangle that nearly all of them are in."""
    high_px: tuple[float, float]
    """Right and bottom."""
    motion: Float64[np.ndarray, " 3"]
    """Of their middle, in the map's world and unit; NaN where one camera cannot tell."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """What was known when a frame came."""

    timestamp_s: float
    state: TrackingState
    reason: str
    """Why there is no place, or why a keyframe was made; empty for nothing to say."""
    world_from_body: Rigid3 | None
    """None where the place is not known."""
    covariance: Float64[np.ndarray, "6 6"] | None
    """Of xi = (translation, rotation) in body_from_world = exp(xi) @ what is stated."""
    num_points: int
    """Points of the map that agree."""
    is_keyframe: bool
    submap_from_body: Rigid3 | None = None
    """The place in the map that the camera is followed in, where that is not the first one."""
    moving: MovingThing | None = None
    """A thing that moves besides the camera."""
    map_number: int = 0
    """Number of the map that the pose refers to, in order of initialization."""

    @property
    def has_pose(self) -> bool:
        """Whether the pose in one of the maps is known."""
        return self.world_from_body is not None or self.submap_from_body is not None

    def with_words(self, words: str) -> TrackedFrame:
        """The same frame with words appended to the reason."""
        return replace(self, reason=f"{self.reason}; {words}" if self.reason else words)

    def __repr__(self) -> str:
        return f"TrackedFrame({self.timestamp_s:.3f} s, {self.state.value}, {self.num_points} points)"
