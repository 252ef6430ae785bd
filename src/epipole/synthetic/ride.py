"""Image sequences of a camera that moves through a synthetic scene, with exact poses and depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from epipole._checks import check_fields, checked
from epipole.cameras import Camera
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3
from epipole.scene import Trajectory
from epipole.synthetic.render import render_exposures
from epipole.synthetic.scene import SyntheticScene

MOST_EXPOSURES = 64


@dataclass(frozen=True, slots=True, kw_only=True)
class Shutter:
    """Exposure and readout of an image. The exposure of the middle row is centered on the frame's time."""

    readout_s: float = 0.0
    """From the first row to the one after the last; 0 is a global shutter."""
    exposure_s: float = 0.0
    """Exposure time of a row; 0 means no motion blur."""
    num_exposures: int = 5
    """Renders averaged for motion blur."""
    noise_sigma: float = 2.0
    """Standard deviation of the sensor noise, in gray levels."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        check_fields(self)
        for name in ("readout_s", "exposure_s", "noise_sigma"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ConfigError(f"{name} must not be negative, got {getattr(self, name)}")
        if not 1 <= self.num_exposures <= MOST_EXPOSURES:
            raise ConfigError(f"num_exposures must be 1 to {MOST_EXPOSURES}, got {self.num_exposures}")

    def times_of(self, timestamp_s: float, num_rows: int) -> Float64[np.ndarray, "exposures rows"]:
        """Times at which the rows of a frame are rendered."""
        row = (np.arange(num_rows) - 0.5 * (num_rows - 1)) / num_rows if self.readout_s > 0 else np.zeros(1)
        count = self.num_exposures if self.exposure_s > 0 else 1
        exposure = (np.arange(count) + 0.5) / count - 0.5
        return timestamp_s + self.exposure_s * exposure[:, None] + self.readout_s * row


@dataclass(frozen=True, slots=True, eq=False)
class RideImage:
    """A gray image and its depth."""

    gray: UInt8[np.ndarray, "h w"]
    depth: Float32[np.ndarray, "h w"]
    """Exact, in meters along the optical axis; 0 for the sky."""


@dataclass(frozen=True, slots=True, eq=False)
class Ride:
    """A moving rectified stereo pair. Frames are rendered on demand."""

    name: str
    camera: Camera
    """Left and right."""
    baseline: float
    """From the left camera to the right one, along its x axis, in meters."""
    timestamp_s: Float64[np.ndarray, " n"]
    world_from_camera_at: Callable[[np.ndarray], Rigid3] = field(repr=False)
    """Poses of the left camera at times (k,)."""
    scene_at: Callable[[float], SyntheticScene] = field(repr=False)
    """The scene at a time."""
    shutter: Shutter = field(default_factory=Shutter)
    gain: Float64[np.ndarray, " n"] | None = None
    """Brightness of each frame; None for 1."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ShapeError: timestamp_s does not increase, or the number of gains differs.
            ConfigError: the baseline is not positive and finite.
        """
        check_fields(self)
        if not np.isfinite(self.timestamp_s).all() or (np.diff(self.timestamp_s) <= 0).any():
            raise ShapeError("timestamp_s must be finite and increase")
        if not 0 < self.baseline < np.inf:
            raise ConfigError(f"baseline must be positive and finite, got {self.baseline}")

    def __len__(self) -> int:
        return len(self.timestamp_s)

    def __repr__(self) -> str:
        return f"Ride({self.name}, {len(self)} frames)"

    @property
    def world_from_camera(self) -> Rigid3:
        """(n,) true poses of the left camera at the frames' times."""
        return self.world_from_camera_at(self.timestamp_s)

    def truth(self) -> Trajectory:
        """The true trajectory of the left camera."""
        return Trajectory(self.timestamp_s, self.world_from_camera)

    @checked
    def left(self, frame: int) -> RideImage:
        """The left image of a frame.

        Raises:
            ConfigError: there is no such frame.
        """
        return self._image(frame, 0)

    @checked
    def right(self, frame: int) -> RideImage:
        """The right image of a frame.

        Raises:
            ConfigError: there is no such frame.
        """
        return self._image(frame, 1)

    def _image(self, frame: int, side: int) -> RideImage:
        if not 0 <= frame < len(self):
            raise ConfigError(f"frame must be 0 to {len(self) - 1}, got {frame}")
        time = float(self.timestamp_s[frame])
        times = self.shutter.times_of(time, self.camera.height)
        positions = self.world_from_camera_at(times.ravel()) @ Rigid3(
            np.eye(3), np.array([side * self.baseline, 0.0, 0.0])
        )
        cam_from_world = positions.inverse()
        rows = Rigid3(
            cam_from_world.rotation.reshape(*times.shape, 3, 3),
            cam_from_world.translation.reshape(*times.shape, 3),
        )
        gain = 1.0 if self.gain is None else float(self.gain[frame])
        rendered = render_exposures(self.scene_at(time), self.camera, rows, gain=gain)
        gray = cv2.cvtColor(rendered.rgb, cv2.COLOR_RGB2GRAY)
        if self.shutter.noise_sigma > 0:
            noise = np.random.default_rng([frame, side]).standard_normal(gray.shape, np.float32)
            noisy = gray + np.float32(self.shutter.noise_sigma) * noise
            gray = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        return RideImage(gray, np.nan_to_num(rendered.depth, nan=0.0).astype(np.float32))
