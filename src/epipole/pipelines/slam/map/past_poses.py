"""Poses of frames between keyframes are estimated again once the map around them has converged."""

from __future__ import annotations

import numpy as np

from epipole.geometry import Rigid3
from epipole.mapping import Disparities, refine_pose
from epipole.pipelines.slam.map.covariance import by_errors
from epipole.pipelines.slam.map.trajectory import Path
from epipole.pipelines.slam.shutter.shutter import CONVERGED_SIGMA
from epipole.pipelines.slam.tracking.points import SeenFrame
from epipole.pipelines.slam.tracking.tracker import PointTracker

KEYFRAMES_LATER = 5
"""Keyframes after a frame until the map around it is assumed to have converged."""


def refine_past_poses(path: Path, tracker: PointTracker, *, is_last: bool = False) -> None:
    """Estimate the poses of waiting frames again from their observations and the present map.

    Args:
        path: trajectory with the poses, updated in place.
        tracker: of the map, with the waiting frames.
        is_last: whether the sequence has ended, so that no frame waits any longer.
    """
    if not tracker.waiting:
        return
    numbers = [keyframe.number for keyframe in tracker.map.keyframes]
    newest_done = numbers[-min(KEYFRAMES_LATER, len(numbers))]
    done = [seen for seen in tracker.waiting if is_last or seen.number < newest_done]
    tracker.waiting = [seen for seen in tracker.waiting if not (is_last or seen.number < newest_done)]
    for seen in done:
        stored = path.stored(seen.number)
        if stored is not None and stored[0].number != seen.number:
            keyframe, relative, covariance = stored
            position, covariance = _localized(seen, tracker, relative @ keyframe.cam_from_world, covariance)
            path.add(seen.number, seen.timestamp_s, keyframe, position, covariance)


def _localized(
    seen: SeenFrame, tracker: PointTracker, start: Rigid3, covariance: np.ndarray
) -> tuple[Rigid3, np.ndarray]:
    """The pose and its covariance relative to the map; unchanged if they cannot be estimated."""
    localized = tracker.map.is_triangulated(seen.point)
    points, pixels = tracker.map.xyz[seen.point[localized]], seen.pixels[localized]
    shutter, config = tracker.sensor.shutter, tracker.config
    if len(points) < config.min_tracked or (shutter.is_rolling and seen.motion is None):
        return start, covariance
    if shutter.is_rolling:
        assert seen.motion is not None
        return shutter.refine(points, pixels, start, seen.motion, sigma=CONVERGED_SIGMA)[0], covariance
    deep = None
    if tracker.focal_baseline is not None and seen.disparity_px is not None:
        deep = Disparities(seen.disparity_px[localized], tracker.focal_baseline, config.depth_sigma_px)
    refined = refine_pose(points, pixels, tracker.camera, start, disparities=deep)
    if tracker.sensor.is_metric:
        covariance = by_errors(refined)
    return refined.cam_from_world, covariance
