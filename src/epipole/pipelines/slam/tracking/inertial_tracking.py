"""Poses predicted by an IMU: the rotation from frame to frame, and the motion while the images show nothing known."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from epipole.errors import DegenerateGeometryError
from epipole.geometry import Rigid3, Similarity3
from epipole.inertial import ImuMotion, MountedImu, carry_motion, fit_imu_motion, preintegrate
from epipole.pipelines.slam.map.imu import InertialConstraints
from epipole.pipelines.slam.map.slam_map import Keyframe

RECENT_S = 1.0
"""Time over which the velocity is estimated."""
LEAST_RECENT = 4
LONGEST_S = 3.0
"""Longest time for which the IMU carries the pose: the error grows with its square."""


class InertialTracking:
    """Predicts poses in one map.

    Attributes:
        carried: motion since the images show nothing known; None while they do.
    """

    def __init__(self, constraints: InertialConstraints) -> None:
        self.constraints = constraints
        constraints.camera_imu.start_map()
        self.carried: ImuMotion | None = None
        self._since_s = 0.0
        self._recent: deque[tuple[float, Rigid3]] = deque()
        self._covariance = np.zeros((6, 6))

    def remember(self, timestamp_s: float, cam_from_world: Rigid3, covariance: np.ndarray) -> None:
        """A frame that was localized by its image, with the covariance of its pose relative to the map."""
        self.constraints.camera_imu.see(timestamp_s, cam_from_world)
        self.carried, self._covariance = None, covariance
        self._recent.append((timestamp_s, cam_from_world))
        while timestamp_s - self._recent[0][0] > RECENT_S:
            self._recent.popleft()

    def move(self, new_from_old: Similarity3) -> None:
        """Go on after an adjustment has moved the world near the camera."""
        self._recent = deque((t, new_from_old.move_cam_from_source(pose)) for t, pose in self._recent)

    def clear(self) -> None:
        """The world near the camera has changed: earlier poses do not show the velocity in it."""
        self._recent.clear()
        self.carried = None

    def rotated(self, cam_from_world: Rigid3, before_s: float, now_s: float) -> Rigid3:
        """The pose after the rotation that the gyroscope measured between two frames.

        Unchanged until the IMU agrees with the trajectory, and where its log does not cover the frames.
        """
        aligned, offset_s = self.constraints.aligned, self.constraints.camera_imu.offset_s
        if aligned is None:
            return cam_from_world
        before_s, now_s = before_s + offset_s, now_s + offset_s
        imu = self._imu_between(before_s, now_s)
        try:
            measured = preintegrate(imu.log, np.array([before_s, now_s]), aligned.gyro_bias)
        except DegenerateGeometryError:
            return cam_from_world
        mount = imu.camera_from_imu.rotation
        return Rigid3(mount @ measured.rotation[0].T @ mount.T, np.zeros(3)) @ cam_from_world

    def carry(self, keyframes: Sequence[Keyframe], timestamp_s: float) -> tuple[Rigid3, np.ndarray] | None:
        """The pose by the IMU alone, with its covariance relative to the map; None if there is no IMU to trust, or for too long."""
        timestamp_s += self.constraints.camera_imu.offset_s
        try:
            if self.carried is None:
                self.carried = self._start(keyframes)
            if self.carried is None or timestamp_s - self._since_s > LONGEST_S:
                return None
            imu = self._imu_between(self.carried.timestamp_s, timestamp_s)
            self.carried = carry_motion(self.carried, timestamp_s, imu)
        except DegenerateGeometryError:
            return None
        return self.carried.cam_from_world(imu.camera_from_imu)

    def velocity_sigma(self) -> float:
        """Standard deviation of the carried motion's velocity, in m / s."""
        assert self.carried is not None
        return float(np.sqrt(np.trace(self.carried.covariance[3:6, 3:6])))

    def _start(self, keyframes: Sequence[Keyframe]) -> ImuMotion | None:
        """The motion at the last frame that its image localized."""
        if len(self._recent) < LEAST_RECENT or not np.isfinite(self._covariance).all():
            return None
        calibration = self.constraints.calibration(keyframes, self._recent[-1][0])
        if calibration is None:
            return None
        times = np.array([t for t, _ in self._recent]) + self.constraints.camera_imu.offset_s
        poses = [pose for _, pose in self._recent]
        there = Rigid3(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses]))
        self._since_s = float(times[-1])
        imu = self._imu_between(times[0], times[-1])
        return fit_imu_motion(times, there.inverse(), self._covariance, imu, calibration)

    def _imu_between(self, start_s: float, stop_s: float) -> MountedImu:
        own = self.constraints
        return replace(own.imu, log=own.imu.log.between(start_s, stop_s), noise=own.noise)
