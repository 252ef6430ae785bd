"""Frames between keyframes are placed again once the map around them has settled: when they came it had not."""

from __future__ import annotations

import numpy as np

from epipole.geometry import Rigid3
from epipole.mapping import Disparities, refine_pose
from epipole.pipelines.slam.map.covariance import by_errors
from epipole.pipelines.slam.map.trajectory import Path
from epipole.pipelines.slam.shutter.motion import CONVERGED_SIGMA, refine_while_moving
from epipole.pipelines.slam.tracking.points import SeenFrame
from epipole.pipelines.slam.tracking.tracker import PointTracker

KEYFRAMES_LATER = 5
"""After a frame, when the map around it has settled."""


def refine_past_poses(path: Path, tracker: PointTracker, *, is_last: bool = False) -> None:
    """Find the places of frames that have waited long enough, by what they saw, in the map as it is now.

    Args:
        path: where they are told from their keyframes, and will be.
        tracker: of the map, with the frames that wait.
        is_last: none comes after them: all have waited long enough.
    """
    if not tracker.waiting:
        return
    numbers = [keyframe.number for keyframe in tracker.map.keyframes]
    converged = numbers[-min(KEYFRAMES_LATER, len(numbers))]
    done = [seen for seen in tracker.waiting if is_last or seen.number < converged]
    tracker.waiting = [seen for seen in tracker.waiting if not (is_last or seen.number < converged)]
    for seen in done:
        stored = path.stored(seen.number)
        if stored is not None and stored[0].number != seen.number:
            keyframe, relative, covariance = stored
            position, covariance = _localized(seen, tracker, relative @ keyframe.cam_from_world, covariance)
            path.add(seen.number, seen.timestamp_s, keyframe, position, covariance)


def _localized(
    seen: SeenFrame, tracker: PointTracker, start: Rigid3, covariance: np.ndarray
) -> tuple[Rigid3, np.ndarray]:
    """The place, and its covariance before the map; as they were where they cannot be told again."""
    localized = tracker.map.is_triangulated(seen.point)
    points, pixels = tracker.map.xyz[seen.point[localized]], seen.pixels[localized]
    readout, config = tracker.sensor.readout_s, tracker.config
    if len(points) < config.min_tracked or (readout and seen.motion is None):
        return start, covariance
    if readout:
        assert seen.motion is not None
        known = tracker.camera, start, seen.motion, readout
        return refine_while_moving(points, pixels, *known, sigma=CONVERGED_SIGMA)[0], covariance
    deep = None
    if tracker.focal_baseline is not None and seen.disparity_px is not None:
        deep = Disparities(seen.disparity_px[localized], tracker.focal_baseline, config.depth_sigma_px)
    refined = refine_pose(points, pixels, tracker.camera, start, disparities=deep)
    if tracker.focal_baseline is not None:
        covariance = by_errors(refined)
    return refined.cam_from_world, covariance
