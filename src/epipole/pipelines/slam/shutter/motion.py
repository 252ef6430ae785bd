"""Images that are read out row by row: what the motion did to them, and how long the readout takes."""

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

UNKNOWN_SIGMA, FORETOLD_SIGMA, CONVERGED_SIGMA = (0.5, 15.0), (0.3, 8.0), (0.01, 0.3)
"""Of a frame's speed, and of its change, in radians, or depths of the scene, per second (squared): where nothing is known of it,
against that by the frames before, and by those on both sides. A looser one lets a bent map, and motions that undo it, agree."""
STEPS, CONVERGED = 8, 1e-7
LONGEST_GAP = 3.0
"""Between a keyframe and the frames beside it, in median gaps: over a longer one its motion is not known."""


def motions_at(path: Trajectory, keyframes: Sequence[Keyframe]) -> np.ndarray:
    """(k, 12) of keyframes' motions by the frames around; NaN where these are too far in time.

    Args:
        path: of all frames.
        keyframes: some of them.
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
    """(n, 3) from where, and at what disparity, a keyframe's points were seen to what a shutter of one instant would have seen.

    Points without a place are taken to be as far as the others (median).

    A row is read at readout (v / height - 1 / 2) after the frame's time, by when the camera has moved on.

    Args:
        model: the map.
        keyframe: one of it.
        motion: (12,) its speed and the change of it, per second and second squared.
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
    """(n, 3) points by depth, seen when their rows were read, in the camera in the middle of the readout."""
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
    """(n, 3) points in the camera in the middle of the readout, by their disparities; NaN without one, or further than that.

    Args:
        model: the map, of a pair with its second camera's principal point.
        seen: pixels and disparities as they were read.
        motion: (12,) of the camera.
        sensor: what tells depth.
        focal_baseline: focal length times baseline.
        most_baselines: distance beyond which a disparity says little.
    """
    disparity = seen.disparity_px + model.right_shift_px
    in_cam = points_by_disparity(seen.pixels, disparity, sensor.camera, focal_baseline, most_baselines)
    return at_middle(in_cam, seen.pixels, motion, sensor.camera, sensor.readout_s)


def straighten(
    model: SlamMap, keyframe: Keyframe, camera: Camera, readout_s: float, least_points: int
) -> None:
    """What a shutter of one instant would have seen, by a keyframe's motion with the map as it is.

    What the rows tell of the motion refines it, within what the frames around it allow; it is not kept, for a map that bends,
    and a motion that bends with it, would follow each other.
    """
    motion, localized = keyframe.motion, model.is_triangulated(keyframe.point)
    if localized.sum() >= least_points and motion.any():
        xyz, pixels = model.xyz[keyframe.point[localized]], keyframe.pixels[localized]
        known = camera, keyframe.cam_from_world, motion, readout_s
        _, motion, _ = refine_while_moving(xyz, pixels, *known, sigma=CONVERGED_SIGMA)
    keyframe.shift_px = shutter_shifts(model, keyframe, motion, camera, readout_s)


def straighten_recent(model: SlamMap, camera: Camera, readout_s: float) -> None:
    """Tell the last keyframes' motions by the frames around them."""
    motions = model.recent.converged()
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
    """Pose and motion of a frame whose rows were read one after another, by robust least squares of both.

    With X' = exp(late xi) T X both change the projection alike, the motion by how late a row is: J = (A, late A) with A the
    derivative by the pose. Where the points tell the motion badly it stays near the one given.

    Args:
        points_in_world: (n, 3).
        pixels: (n, 2) where they are seen.
        camera: any model.
        start: cam_from_world thought likely.
        motion: (12,) speed and its change thought likely.
        readout_s: from the first row to the one after the last.
        sigma: of the motion's speed, and of its change, in radians, or depths of the scene, per second (squared).

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
        weight = np.where(seen, 1.0 / (1.0 + np.where(seen, error_sq, 0.0)), 0.0)  # Cauchy's, of a pixel
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
    """(n, 6) tangents of the motion by then: speed, and half its change."""
    return late[:, None] * motion[:6] + 0.5 * late[:, None] ** 2 * motion[6:]


def _by_pose(camera: Camera, in_cam: np.ndarray) -> np.ndarray:
    """(n, 2, 6) derivative of pixels by exp(xi), through that by the point, by differences."""
    size = 1e-6 * in_cam[:, 2:]
    by_point = np.stack(
        [
            (camera.project(in_cam + size * axis) - camera.project(in_cam - size * axis)) / (2.0 * size)
            for axis in np.eye(3)
        ],
        axis=2,
    )
    return np.concatenate([by_point, -by_point @ skew(in_cam)], axis=2)
