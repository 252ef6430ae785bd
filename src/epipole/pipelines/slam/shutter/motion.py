"""Rolling shutter: correction of observations by the camera's motion, and joint estimation of pose and motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rigid3, skew
from epipole.pipelines.slam.frames import SlamCamera
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations, SlamMap
from epipole.pipelines.slam.shutter.recent_motion import AROUND, motion_among
from epipole.pipelines.slam.tracking.depth import points_by_disparity
from epipole.scene import Trajectory

UNKNOWN_SIGMA = (0.5, 15.0)
"""Standard deviations of a frame's velocity and acceleration, in radians or scene depths per second (squared), without a prior.
Looser values let a bent map agree with motions that compensate it."""
FORETOLD_SIGMA = (0.3, 8.0)
"""The same relative to the motion predicted from the previous frames."""
CONVERGED_SIGMA = (0.01, 0.3)
"""The same relative to the motion interpolated from the frames on both sides."""
STEPS, CONVERGED = 8, 1e-7
LONGEST_GAP = 3.0
"""Largest gap between the frames around a keyframe, in median gaps, for which its motion is known."""


def motions_at(path: Trajectory, keyframes: Sequence[Keyframe]) -> np.ndarray:
    """(k, 12) motions of keyframes from the frames around them; NaN where these are too far apart in time.

    Args:
        path: trajectory of all frames.
        keyframes: keyframes among them.
    """
    out = np.full((len(keyframes), 12), np.nan)
    if len(path) < AROUND:
        return out
    times, cams = path.timestamp_s, path.world_from_body.inverse()
    gap = LONGEST_GAP * float(np.median(np.diff(times)))
    for k, keyframe in enumerate(keyframes):
        at = int(np.searchsorted(times, keyframe.timestamp_s))
        first = min(max(at - AROUND // 2, 0), len(times) - AROUND)
        near = slice(first, first + AROUND)
        if np.diff(times[near]).max() <= gap and 0 <= at - first < AROUND:
            out[k] = motion_among(times[near], cams[near], at - first)
    return out


def shutter_shifts(
    model: SlamMap, keyframe: Keyframe, motion: np.ndarray, camera: Camera, readout_s: float
) -> np.ndarray:
    """(n, 3) shifts of a keyframe's pixels and disparities to those that a global shutter would have observed.

    Row v is read at readout (v / height - 1 / 2) after the frame's time. Points that are not triangulated get the median depth
    of the others.

    Args:
        model: the map.
        keyframe: one of its keyframes.
        motion: (12,) velocity and acceleration, per second and second squared.
        camera: any model.
        readout_s: from the first row to the one after the last.
    """
    if readout_s == 0 or not len(keyframe.point):
        return np.zeros((len(keyframe.point), 3))
    in_cam = keyframe.cam_from_world.apply(model.xyz[keyframe.point])
    localized = in_cam[:, 2] > 0
    rays = camera.unproject(keyframe.pixels)
    far = rays / rays[:, 2:] * (np.median(in_cam[localized, 2]) if localized.any() else 1.0)
    in_cam = np.where(localized[:, None], in_cam, far)
    moved = Rigid3.exp(_moved(motion, _late(keyframe.pixels, camera, readout_s))).apply(in_cam)
    nearer = keyframe.disparity_px * (moved[:, 2] / in_cam[:, 2] - 1.0)
    shift = np.column_stack([camera.project(in_cam) - camera.project(moved), nearer])
    shift[:, 2][~np.isfinite(nearer)] = 0.0
    return np.where(np.isfinite(shift).all(axis=1, keepdims=True), shift, 0.0)


def at_middle(
    in_cam: np.ndarray, pixels: np.ndarray, motion: np.ndarray, camera: Camera, readout_s: float
) -> np.ndarray:
    """(n, 3) transform points from the camera when their rows were read to the camera in the middle of the readout."""
    if readout_s == 0 or not motion.any():
        return in_cam
    late = _late(pixels, camera, readout_s)
    return Rigid3.exp(_moved(motion, late)).inverse().apply(in_cam)


def points_by_depth(
    model: SlamMap,
    seen: Observations,
    motion: np.ndarray,
    sensor: SlamCamera,
    focal_baseline: float,
    most_baselines: float,
) -> np.ndarray:
    """(n, 3) points from disparities, in the camera in the middle of the readout; NaN without a disparity or too far away.

    Args:
        model: the map, with the principal point shift of a pair's second camera.
        seen: pixels and disparities as observed.
        motion: (12,) motion of the camera.
        sensor: the camera with its source of depth.
        focal_baseline: focal length times baseline.
        most_baselines: largest distance, in baselines.
    """
    disparity = seen.disparity_px + model.right_shift_px
    in_cam = points_by_disparity(seen.pixels, disparity, sensor.camera, focal_baseline, most_baselines)
    return at_middle(in_cam, seen.pixels, motion, sensor.camera, sensor.readout_s)


def straighten(
    model: SlamMap, keyframe: Keyframe, camera: Camera, readout_s: float, least_points: int
) -> None:
    """Shift a keyframe's observations to those of a global shutter, by its motion.

    The motion is refined from the rows within `CONVERGED_SIGMA`, but the refined motion is not stored: otherwise a bent map and
    the motion could drift together.
    """
    motion, localized = keyframe.motion, model.is_triangulated(keyframe.point)
    if localized.sum() >= least_points and motion.any():
        xyz, pixels = model.xyz[keyframe.point[localized]], keyframe.pixels[localized]
        known = camera, keyframe.cam_from_world, motion, readout_s
        _, motion, _ = refine_while_moving(xyz, pixels, *known, sigma=CONVERGED_SIGMA)
    keyframe.shift_px = shutter_shifts(model, keyframe, motion, camera, readout_s)


def straighten_recent(model: SlamMap, camera: Camera, readout_s: float) -> None:
    """Update the motions and shifts of the last keyframes from the frames around them."""
    motions = model.recent.final_motions()
    for keyframe in model.keyframes[-AROUND:]:
        motion = motions.get(keyframe.timestamp_s)
        if motion is not None and motion.any():
            keyframe.motion = motion
            keyframe.shift_px = shutter_shifts(model, keyframe, motion, camera, readout_s)


def refine_while_moving(
    points_in_world: np.ndarray,
    pixels: np.ndarray,
    camera: Camera,
    start: Rigid3,
    motion: np.ndarray,
    readout_s: float,
    *,
    sigma: tuple[float, float] = UNKNOWN_SIGMA,
) -> tuple[Rigid3, np.ndarray, np.ndarray]:
    """Pose and motion of a frame with a rolling shutter, jointly by robust least squares.

    With X' = exp(late xi) T X, where `late` is the time of a row after the middle of the readout, the Jacobian is (A, late A) with
    A the derivative by the pose. Where the points determine the motion badly it stays near the given one.

    Args:
        points_in_world: (n, 3).
        pixels: (n, 2) observations.
        camera: any model.
        start: initial cam_from_world.
        motion: (12,) predicted velocity and acceleration.
        readout_s: from the first row to the one after the last.
        sigma: standard deviations of velocity and acceleration, in radians or scene depths per second (squared).

    Returns:
        cam_from_world in the middle of the readout, the motion, and the squared errors (n,).
    """
    late = _late(pixels, camera, readout_s)
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


def _late(pixels: np.ndarray, camera: Camera, readout_s: float) -> np.ndarray:
    """(n,) seconds after the middle of the readout at which rows are read."""
    return readout_s * ((pixels[:, 1] + 0.5) / camera.height - 0.5)


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
