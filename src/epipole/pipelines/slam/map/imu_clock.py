"""The IMU of a camera: its measurements so far, and the offset of its clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from epipole.errors import DegenerateGeometryError
from epipole.geometry import Rigid3, Rotation3
from epipole.inertial import ImuBuffer, ImuClock, ImuLog, MountedImu, fit_imu_clock
from epipole.pipelines.slam.map.slam_map import Keyframe

LEAST_S, PATIENCE_S = 3.0, 6.0
"""Time from which the offset is estimated, and after which one that the motion does not show is assumed to be zero."""
MOST_FRAMES, MARGIN_S = 1000, 0.4
LEAST_OFFSET_S = 2e-3
"""Smallest offset that is applied."""
LEAST_ROTATION_RAD = 0.0175
"""Smallest error of the mounting that is reported."""


class CameraImu:
    """An IMU on the tracked camera, shared by all maps.

    Attributes:
        imu: measurements so far, mounting and noise.
        clock: clock offset and rotation of the mounting as the images alone show them; None if they do not.
        offset_s: what to add to a time by the camera's clock; zero unless the offset is significant.
        other_reading: how the measurements are to be read to fit the trajectory, in words; empty if they fit as they are, or not at all.
        is_used: whether poses depend on the IMU, which then cannot show its clock any more: they agree with any offset.
    """

    def __init__(self, imu: MountedImu) -> None:
        self.imu, self._buffer = imu, ImuBuffer(imu.log)
        self.clock: ImuClock | None = None
        self.offset_s = 0.0
        self.other_reading = ""
        self.is_used = False
        self._seen: list[tuple[float, Rigid3]] = []

    def add(self, samples: ImuLog) -> None:
        """Add measurements as they arrive.

        Raises:
            ShapeError: they are not later than those before.
        """
        self._buffer.add(samples)
        self.imu = replace(self.imu, log=self._buffer.log)

    def start_map(self) -> None:
        """The frames that follow are in another world."""
        self._seen = []

    def see(self, timestamp_s: float, cam_from_world: Rigid3) -> None:
        """A frame as its image localized it, without the IMU."""
        if self.clock is None and not self.is_used:
            self._seen = [*self._seen[1 - MOST_FRAMES :], (timestamp_s, cam_from_world)]

    def is_clock_known(self, *, is_last: bool) -> bool:
        """Estimate the offset, if it is not known; whether the IMU may be used, with the estimate or without one.

        Args:
            is_last: there will be no more frames.
        """
        seen_s = self._seen[-1][0] - self._seen[0][0] if self._seen else 0.0
        if self.clock is None and not self.is_used and seen_s >= LEAST_S:
            self._learn()
        return self.clock is not None or self.is_used or is_last or seen_s >= PATIENCE_S

    def _learn(self) -> None:
        times, poses = zip(*list(self._seen))
        rotation = np.stack([pose.rotation.T for pose in poses])
        try:
            log = self.imu.log.between(times[0] - MARGIN_S, times[-1] + MARGIN_S)
            there = Rigid3(rotation, np.zeros((len(times), 3)))
            found = fit_imu_clock(np.array(times), there, replace(self.imu, log=log))
        except DegenerateGeometryError:
            return
        self.clock = found
        if abs(found.offset_s) > max(3.0 * found.offset_sigma_s, LEAST_OFFSET_S):
            self.offset_s = found.offset_s

    def notes(self) -> list[str]:
        """What clock and mounting turned out to be, if they are not as given."""
        if self.clock is None:
            words = "the motion does not show the offset of the IMU's clock: it was assumed to be zero"
            return [words] if self.is_used else []
        out, sigma_s = [], self.clock.offset_sigma_s
        if self.offset_s:
            side = "ahead of" if self.offset_s > 0 else "behind"
            out.append(
                f"the IMU's clock is {1e3 * abs(self.offset_s):.1f} +- {1e3 * sigma_s:.1f} ms {side} the camera's: corrected"
            )
        given = Rotation3(self.imu.camera_from_imu.rotation)
        off = np.asarray((Rotation3(self.clock.rotation) @ given.inverse()).log())
        sigma = float(np.sqrt(np.linalg.eigvalsh(self.clock.rotation_covariance)[-1]))
        angle = float(np.linalg.norm(off))
        if angle > max(4.0 * sigma, LEAST_ROTATION_RAD):
            axis = ", ".join(f"{v:.2f}" for v in off / angle)
            out.append(
                f"the IMU's mounting differs by {np.degrees(angle):.1f} +- {np.degrees(sigma):.1f} degrees from the given one, about"
                f" ({axis}) in the camera's axes: check it"
            )
        return out


def path_of(keyframes: Sequence[Keyframe]) -> tuple[np.ndarray, Rigid3]:
    """Times and world_from_camera of keyframes."""
    positions = [k.cam_from_world for k in keyframes]
    there = Rigid3(np.stack([p.rotation for p in positions]), np.stack([p.translation for p in positions]))
    return np.array([k.timestamp_s for k in keyframes]), there.inverse()
