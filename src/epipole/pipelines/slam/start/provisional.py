"""A map at a pose that an IMU has carried, which joins the main one only if its images move as the IMU says."""

from __future__ import annotations

from enum import Enum

import numpy as np

from epipole.geometry import Rigid3
from epipole.pipelines.slam.frames import Frame
from epipole.pipelines.slam.map.local_mapping import LocalMapper
from epipole.pipelines.slam.odometry import Odometry

CONFIRMED_S = 0.4
"""Shortest time of agreement."""
LEAST_M = 0.02
"""Smallest difference of positions that counts as a contradiction, in meters."""
SIGMAS = 3.0
DISTANCE = 2.0
"""The camera must have moved by this multiple of the difference that would contradict: at rest everything agrees."""


class Agreement(Enum):
    """What the frames so far say."""

    OPEN = "open"
    CONFIRMED = "confirmed"
    REFUTED = "refuted"


class ProvisionalMap:
    """What the camera sees since the IMU has carried it out of the map: the scene, or something that moves before it.

    Attributes:
        odometry: tracks the camera in it, in the world of the main map.
    """

    def __init__(self, mapper: LocalMapper, frame: Frame, number: int, cam_from_world: Rigid3) -> None:
        self.odometry = Odometry(mapper, cam_from_world)
        self.odometry.insert_keyframe(frame, number)
        self._start_s, self._start, self._before = frame.timestamp_s, cam_from_world.inverse(), frame

    @property
    def is_rich(self) -> bool:
        """Whether enough points have depth."""
        points = self.odometry.tracker.tracks.point
        count = int(self.odometry.map.is_triangulated(points).sum())
        return count >= self.odometry.config.min_tracked

    def add(self, frame: Frame, carried: Rigid3, velocity_sigma: float) -> Agreement:
        """Track a frame and compare its motion since the first one with that by the IMU.

        Args:
            frame: the next frame.
            carried: cam_from_world by the IMU alone.
            velocity_sigma: standard deviation of the IMU's velocity, in m / s.
        """
        found = self.odometry.track(self._before, frame)
        if found is None:
            return Agreement.REFUTED
        self._before, self.odometry.cam_from_world = frame, found[0].cam_from_world
        seen, by_imu = found[0].cam_from_world.inverse(), carried.inverse()
        seconds = frame.timestamp_s - self._start_s
        most = LEAST_M + SIGMAS * velocity_sigma * seconds
        if np.linalg.norm(seen.translation - by_imu.translation) > most:
            return Agreement.REFUTED
        moved = float(np.linalg.norm(by_imu.translation - self._start.translation))
        is_confirmed = seconds >= CONFIRMED_S and moved > DISTANCE * most
        return Agreement.CONFIRMED if is_confirmed else Agreement.OPEN
