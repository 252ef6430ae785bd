"""Whether a state that was read from disk can be gone on in: kernels would read beyond arrays that do not fit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.pipelines.slam.frames import Frame, TrackingState
from epipole.pipelines.slam.map_tracking import MapTracker
from epipole.pipelines.slam.slam_map import Keyframe, SlamMap
from epipole.pipelines.slam.tracking import SeenFrame, Tracks


def problem_of_state(held: dict[str, Any], lens: Camera) -> str:
    """What does not fit in the attributes of a `Slam`; empty where all does."""
    try:
        return next(_problems(held, lens), "")
    except (KeyError, AttributeError, TypeError, ValueError, IndexError) as error:
        return f"its objects do not fit ({error})"


def _problems(held: dict[str, Any], lens: Camera) -> Iterator[str]:
    size = (lens.height, lens.width)
    maps, tracker = held["maps"], held["tracker"]
    if not isinstance(held["state"], TrackingState) or not isinstance(tracker, MapTracker):
        yield "it has no state of tracking"
    if not any(held["map"] is one is tracker.map is held["mapper"].map for one in maps):
        yield "the map is none of the maps"
    for model in maps:
        if not isinstance(model, SlamMap):
            yield "a map is none"
        yield from _of_map(model, size)
    tracks = tracker.tracks
    if held["map"].num_points:
        yield from _of_tracks(tracks, held["map"].num_points)
    for seen in tracker.waiting:
        yield from _of_seen(seen, tracker.map.num_points)
    if not _is(tracker.stale, np.integer, (None,)):
        yield "an array of points is none"
    before = held["_before"]
    if before is not None and not (isinstance(before, Frame) and _is(before.grey, np.uint8, size)):
        yield "the last frame is none"
    if not isinstance(held["_cam_from_world"], Rigid3):
        yield "the last place is none"
    for name in ("_num_frames", "_num_lost", "first_number", "first_frame"):
        if type(held[name]) is not int:
            yield f"{name} is no number"


def _of_map(model: SlamMap, size: tuple[int, int]) -> Iterator[str]:
    count, p = len(model.keyframes), model.num_points
    shapes = {"_xyz": (np.float64, (p, 3)), "_anchor": (np.integer, (p,))}
    shapes |= {"_anchor_px": (np.float64, (p, 2)), "_num_agreed": (np.integer, (p,))}
    for name, (kind, shape) in shapes.items():
        if not _is(getattr(model, name), kind, shape):
            yield f"{name[1:]} of a map is of another shape"
    if p and not (model.anchor.min() >= 0 and model.anchor.max() < count):
        yield "a point has no keyframe"
    for keyframe in model.keyframes:
        yield from _of_keyframe(keyframe, p, size)


def _of_keyframe(keyframe: Keyframe, num_points: int, size: tuple[int, int]) -> Iterator[str]:
    n = len(keyframe.point)
    fits = (
        _is(keyframe.point, np.integer, (n,))
        and _is(keyframe.pixels, np.float64, (n, 2))
        and _is(keyframe.disparity_px, np.float64, (n,))
        and _is(keyframe.descriptors, np.uint8, (n, 128))
        and _is(keyframe.grey, np.uint8, size)
        and isinstance(keyframe.cam_from_world, Rigid3)
        and _is(keyframe.cam_from_world.rotation, np.float64, (3, 3))
        and _is(keyframe.cam_from_world.translation, np.float64, (3,))
    )
    if not fits:
        yield "a keyframe's arrays do not fit each other"
    elif n and not (keyframe.point.min() >= 0 and keyframe.point.max() < num_points):
        yield "a keyframe sees a point that is not there"


def _of_tracks(tracks: Tracks, num_points: int) -> Iterator[str]:
    n = len(tracks.point)
    if not (
        _is(tracks.point, np.integer, (n,))
        and _is(tracks.pixels, np.float64, (n, 2))
        and _is(tracks.start_px, np.float64, (n, 2))
    ):
        yield "the arrays of the points that are followed do not fit each other"
    elif n and not (tracks.point.min() >= 0 and tracks.point.max() < num_points):
        yield "a point is followed that is not there"


def _of_seen(seen: SeenFrame, num_points: int) -> Iterator[str]:
    n = len(seen.point)
    fits = (
        _is(seen.point, np.integer, (n,))
        and _is(seen.pixels, np.float64, (n, 2))
        and type(seen.number) is int
    )
    deep, motion = seen.disparity_px, seen.motion
    if not (
        fits
        and (deep is None or _is(deep, np.float64, (n,)))
        and (motion is None or _is(motion, np.float64, (12,)))
    ):
        yield "what a frame saw does not fit together"
    elif n and not (seen.point.min() >= 0 and seen.point.max() < num_points):
        yield "a frame sees a point that is not there"


def _is(array: object, kind: type, shape: tuple[int | None, ...]) -> bool:
    """Whether it is an array of this kind and shape, of which None is any length."""
    return (
        isinstance(array, np.ndarray)
        and np.issubdtype(array.dtype, kind)
        and array.ndim == len(shape)
        and all(b is None or a == b for a, b in zip(array.shape, shape))
    )
