"""Shutter of a camera: the times at which its rows are read, and joint estimation of pose and motion from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rigid3, skew

UNKNOWN_SIGMA = (0.5, 15.0)
"""Standard deviations of a frame's velocity and acceleration, in radians or scene depths per second (squared), without a prior.
Looser values let a bent map agree with motions that compensate it."""
PREDICTED_SIGMA = (0.3, 8.0)
"""The same relative to the motion predicted from the previous frames."""
CONVERGED_SIGMA = (0.01, 0.3)
"""The same relative to the motion interpolated from the frames on both sides."""
STEPS, CONVERGED = 8, 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class Shutter:
    """Row v of an image is read at readout (v / height - 1 / 2) after the frame's time.

    Motions are (12,): the camera's velocity and acceleration as tangents of exp, per second and second squared.
    """

    camera: Camera
    readout_s: float
    """From the first row to the one after the last; 0: global shutter."""

    @property
    def is_rolling(self) -> bool:
        """Whether rows are read one after another."""
        return self.readout_s > 0

    def shifts(
        self, in_cam: np.ndarray, pixels: np.ndarray, disparity_px: np.ndarray, motion: np.ndarray
    ) -> np.ndarray:
        """(n, 3) shifts of pixels and disparities to those that a global shutter would have observed; 0 where they are unknown.

        Args:
            in_cam: (n, 3) observed points, in the camera in the middle of the readout.
            pixels: (n, 2) observations.
            disparity_px: (n,) disparities; NaN where there is none.
            motion: (12,).
        """
        moved = Rigid3.exp(_moved(motion, self._late(pixels))).apply(in_cam)
        nearer = disparity_px * (moved[:, 2] / in_cam[:, 2] - 1.0)
        shift = np.column_stack([self.camera.project(in_cam) - self.camera.project(moved), nearer])
        shift[:, 2][~np.isfinite(nearer)] = 0.0
        return np.where(np.isfinite(shift).all(axis=1, keepdims=True), shift, 0.0)

    def at_middle(self, in_cam: np.ndarray, pixels: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """(n, 3) transform points from the camera when their rows were read to the camera in the middle of the readout."""
        if not self.is_rolling or not motion.any():
            return in_cam
        return Rigid3.exp(_moved(motion, self._late(pixels))).inverse().apply(in_cam)

    def refine(
        self,
        points_in_world: np.ndarray,
        pixels: np.ndarray,
        start: Rigid3,
        motion: np.ndarray,
        *,
        sigma: tuple[float, float] = UNKNOWN_SIGMA,
    ) -> tuple[Rigid3, np.ndarray, np.ndarray]:
        """Pose and motion of a frame, jointly by robust least squares.

        With X' = exp(late xi) T X, where `late` is the time of a row after the middle of the readout, the Jacobian is (A, late A)
        with A the derivative by the pose. Where the points determine the motion badly it stays near the given one.

        Args:
            points_in_world: (n, 3).
            pixels: (n, 2) observations.
            start: initial cam_from_world.
            motion: (12,) predicted motion.
            sigma: standard deviations of velocity and acceleration, in radians or scene depths per second (squared).

        Returns:
            cam_from_world in the middle of the readout, the motion, and the squared errors (n,).
        """
        camera, late = self.camera, self._late(pixels)
        position, given, motion = start, motion, motion.copy()
        depth = max(float(np.median(start.apply(points_in_world)[:, 2])), 1e-6)
        unit = np.array([depth, depth, depth, 1.0, 1.0, 1.0])
        deviation = np.concatenate([sigma[0] * unit, sigma[1] * unit])
        error_sq = np.full(len(pixels), np.inf)
        for _ in range(STEPS):
            moved = Rigid3.exp(_moved(motion, late)).apply(position.apply(points_in_world))
            off = camera.project(moved) - pixels
            error_sq = (off**2).sum(axis=1)
            seen = np.isfinite(error_sq) & (moved[:, 2] > 0)
            weight = np.where(seen, 1.0 / (1.0 + np.where(seen, error_sq, 0.0)), 0.0)  # Cauchy loss, 1 px
            by_pose = _by_pose(camera, np.where(seen[:, None], moved, [0.0, 0.0, depth]))
            when = late[:, None, None]
            jacobian = np.concatenate([by_pose, when * by_pose, 0.5 * when**2 * by_pose], axis=2)
            weighted = jacobian * weight[:, None, None]
            normal = np.einsum("nri,nrj->ij", weighted, jacobian)
            gradient = np.einsum("nri,nr->i", weighted, np.where(seen[:, None], off, 0.0))
            normal[range(6, 18), range(6, 18)] += 1.0 / deviation**2
            gradient[6:] += (motion - given) / deviation**2
            step = -np.linalg.solve(normal + 1e-9 * np.diag(np.diag(normal)), gradient)
            position, motion = Rigid3.exp(step[:6]) @ position, motion + step[6:]
            if np.abs(step[:6]).max() < CONVERGED:
                break
        return position, motion, np.where(np.isfinite(error_sq), error_sq, np.inf)

    def _late(self, pixels: np.ndarray) -> np.ndarray:
        """(n,) seconds after the middle of the readout at which rows are read."""
        return self.readout_s * ((pixels[:, 1] + 0.5) / self.camera.height - 0.5)


def _moved(motion: np.ndarray, late: np.ndarray) -> np.ndarray:
    """(n, 6) tangents of the motion at these times, from velocity and acceleration."""
    return late[:, None] * motion[:6] + 0.5 * late[:, None] ** 2 * motion[6:]


def _by_pose(camera: Camera, in_cam: np.ndarray) -> np.ndarray:
    """(n, 2, 6) derivative of pixels by the pose, exp(xi); numerical by the point."""
    size = 1e-6 * in_cam[:, 2:]
    by_point = np.stack(
        [
            (camera.project(in_cam + size * axis) - camera.project(in_cam - size * axis)) / (2.0 * size)
            for axis in np.eye(3)
        ],
        axis=2,
    )
    return np.concatenate([by_point, -by_point @ skew(in_cam)], axis=2)
