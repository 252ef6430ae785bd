"""Culling of redundant keyframes and points, so that revisiting a scene for hours does not enlarge the map."""

from __future__ import annotations

import numpy as np

from epipole.pipelines.slam.map.slam_map import Keyframe, SlamMap
from epipole.pipelines.slam.map.trajectory import Path
from epipole.pipelines.slam.tracking.tracker import PointTracker

MOST_IN_SIGHT = 40
"""Keyframes with points in common with the newest; beyond that number, redundant ones are culled."""
MOST_TAKEN = 2
"""Keyframes culled at a time: with one per new keyframe their number would never fall."""
SHARED_POINTS = 15
LATEST = 8
"""Newest keyframes that are never culled, since they are still in use."""
OFTEN = 3
"""A keyframe is not needed for a point that more than OFTEN keyframes observe."""
LEAST_REDUNDANT = 0.8
SPARE_ROWS = 2.0
"""Unused rows are removed when the number of rows exceeds that of used points by this factor."""


def cull(model: SlamMap, path: Path, tracker: PointTracker) -> None:
    """Cull redundant keyframes and unused points; trajectory and tracker are updated."""
    for _ in range(MOST_TAKEN):
        taken = cull_redundant_keyframe(model)
        if taken is None:
            break
        path.retell(*taken)
    seen = [tracker.tracks.point, *(one.point for one in tracker.waiting)]
    into = drop_unused_points(model, np.concatenate(seen))
    if into is not None:
        tracker.move_rows(into)


def cull_redundant_keyframe(model: SlamMap) -> tuple[Keyframe, Keyframe] | None:
    """Remove the latest redundant keyframe near the newest one, if there are too many.

    Keyframes of the first visit stay and constrain later ones. Without them every visit would rebuild the map from the previous
    one, and it would drift (37 mm after 50 rounds of the rendered room).

    Returns:
        the removed keyframe, and the one with most points in common with it; None if nothing was removed.
    """
    count = len(model.keyframes)
    shared = model.num_shared([count - 1])
    near = np.flatnonzero(shared >= SHARED_POINTS)
    near = near[(near > 0) & (near < count - LATEST)]
    if len(near) <= MOST_IN_SIGHT:
        return None
    seen = model.counts(list(range(count)))
    redundant = np.array([_redundancy(model, int(k), seen) for k in near])
    spare = near[redundant >= LEAST_REDUNDANT]
    if not len(spare):
        return None
    latest = int(spare[-1])
    others = model.num_shared([latest])
    others[latest] = -1
    gone, heir = model.keyframes[latest], model.keyframes[int(np.argmax(others))]
    model.remove_keyframe(latest)
    return gone, heir


def _redundancy(model: SlamMap, number: int, seen: np.ndarray) -> float:
    """Fraction of a keyframe's points that enough others observe."""
    points = model.keyframes[number].point
    points = points[model.is_triangulated(points)]
    return float((seen[points] > OFTEN).mean()) if len(points) else 1.0


def drop_unused_points(model: SlamMap, tracked: np.ndarray) -> np.ndarray | None:
    """Remove the rows of points that are neither observed by a keyframe nor tracked, if they are many.

    Returns:
        (p,) new row of each point, -1 if removed; None if nothing was done.
    """
    used = model.counts(list(range(len(model.keyframes)))) > 0
    used[tracked] = True
    if model.num_points <= max(SPARE_ROWS * used.sum(), 4096):
        return None
    return model.keep_points(used)
