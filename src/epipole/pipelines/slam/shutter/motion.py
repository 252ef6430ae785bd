"""Rolling shutter in a map: the motions of its keyframes, and their observations as a global shutter would have made them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from epipole.pipelines.slam.frames import SlamCamera
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations, SlamMap
from epipole.pipelines.slam.shutter.recent_motion import AROUND, motion_among
from epipole.pipelines.slam.shutter.shutter import CONVERGED_SIGMA, Shutter
from epipole.pipelines.slam.tracking.depth import points_by_disparity
from epipole.scene import Trajectory

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


def shutter_shifts(model: SlamMap, keyframe: Keyframe, motion: np.ndarray, shutter: Shutter) -> np.ndarray:
    """(n, 3) shifts of a keyframe's pixels and disparities to those that a global shutter would have observed.

    Points that are not triangulated get the median depth of the others.

    Args:
        model: the map.
        keyframe: one of its keyframes.
        motion: (12,) of the keyframe.
        shutter: of the camera.
    """
    if not shutter.is_rolling or not len(keyframe.point):
        return np.zeros((len(keyframe.point), 3))
    in_cam = keyframe.cam_from_world.apply(model.xyz[keyframe.point])
    localized = in_cam[:, 2] > 0
    rays = shutter.camera.unproject(keyframe.pixels)
    far = rays / rays[:, 2:] * (np.median(in_cam[localized, 2]) if localized.any() else 1.0)
    in_cam = np.where(localized[:, None], in_cam, far)
    return shutter.shifts(in_cam, keyframe.pixels, keyframe.disparity_px, motion)


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
    return sensor.shutter.at_middle(in_cam, seen.pixels, motion)


def straighten(model: SlamMap, keyframe: Keyframe, shutter: Shutter, least_points: int) -> None:
    """Shift a keyframe's observations to those of a global shutter, by its motion.

    The motion is refined from the rows within `CONVERGED_SIGMA`, but the refined motion is not stored: otherwise a bent map and
    the motion could drift together.
    """
    motion, localized = keyframe.motion, model.is_triangulated(keyframe.point)
    if localized.sum() >= least_points and motion.any():
        xyz, pixels = model.xyz[keyframe.point[localized]], keyframe.pixels[localized]
        _, motion, _ = shutter.refine(xyz, pixels, keyframe.cam_from_world, motion, sigma=CONVERGED_SIGMA)
    keyframe.shift_px = shutter_shifts(model, keyframe, motion, shutter)


def straighten_recent(model: SlamMap, shutter: Shutter) -> None:
    """Update the motions and shifts of the last keyframes from the frames around them."""
    motions = model.recent.final_motions()
    for keyframe in model.keyframes[-AROUND:]:
        motion = motions.get(keyframe.timestamp_s)
        if motion is not None and motion.any():
            keyframe.motion = motion
            keyframe.shift_px = shutter_shifts(model, keyframe, motion, shutter)
