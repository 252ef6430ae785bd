"""Keyframes and points that tell nothing new are forgotten: a place that is seen for hours costs no more than one seen once."""

from __future__ import annotations

import numpy as np

from epipole.pipelines.slam.map.slam_map import Keyframe, SlamMap
from epipole.pipelines.slam.map.trajectory import Path
from epipole.pipelines.slam.tracking.tracker import PointTracker

MOST_IN_SIGHT = 40
"""Keyframes that share points with the newest; of more the one that tells least is forgotten."""
MOST_TAKEN = 2
"""At a time: with one for each new keyframe their number would never fall where it has grown."""
SHARED_POINTS = 15
LATEST = 8
"""Keyframes that are still in use."""
OFTEN = 3
"""A point that so many other keyframes see does not need this one."""
LEAST_REDUNDANT = 0.8
SPARE_ROWS = 2.0
"""Rows of points are put together when there are so many times more than points in use."""


def cull(model: SlamMap, path: Path, tracker: PointTracker) -> None:
    """Let go of what tells nothing new; frames and followed points are told from what stays."""
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
    """Take the latest of the redundant keyframes around the newest out of the map, if they are too many.

    Those of the first visit stay, and hold the later ones: were they taken, the map would be made anew with every visit, from what
    the last one left, and would wander (the rendered room, 50 times round: 37 mm).

    Returns:
        the keyframe that was taken out, and the one that shares most points with it; None where none was.
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
    """Share of a keyframe's points that enough others see."""
    points = model.keyframes[number].point
    points = points[model.is_triangulated(points)]
    return float((seen[points] > OFTEN).mean()) if len(points) else 1.0


def drop_unused_points(model: SlamMap, tracked: np.ndarray) -> np.ndarray | None:
    """Give up the rows of points that no keyframe sees and that are not followed, where they are many.

    Returns:
        (p,) what each row has become, -1 for those that are gone; None where nothing was done.
    """
    used = model.counts(list(range(len(model.keyframes)))) > 0
    used[tracked] = True
    if model.num_points <= max(SPARE_ROWS * used.sum(), 4096):
        return None
    return model.keep_points(used)
