"""Whether a state that was read from disk can be gone on in: kernels would read beyond arrays that do not fit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from epipole.errors import EpipoleError
from epipole.geometry import Rigid3
from epipole.pipelines.slam.frames import Frame, SlamCamera, TrackingState
from epipole.pipelines.slam.local_mapping import LocalMapper
from epipole.pipelines.slam.loop_closing import LoopCloser
from epipole.pipelines.slam.map_tracking import MapTracker
from epipole.pipelines.slam.path import BLOCK, KEYFRAME, Path
from epipole.pipelines.slam.picture_watch import Look, PictureWatch
from epipole.pipelines.slam.place_recognition import look_size
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.slam_map import Keyframe, SlamMap
from epipole.pipelines.slam.starting import OneCameraStart
from epipole.pipelines.slam.turning import Turning

_KINDS: dict[str, type] = {
    **{"state": TrackingState, "tracker": MapTracker, "mapper": LocalMapper, "_closer": LoopCloser},
    **{"_start": OneCameraStart, "_watch": PictureWatch, "_look": Look, "_path": Path},
    **{"_cam_from_world": Rigid3, "maps": list, "_turns": dict, "start_doubts": list},
    **dict.fromkeys(("_num_frames", "_num_lost", "_num_maps", "first_number", "first_frame"), int),
}
"""Of the attributes of a `Slam`."""
_GIVEN = ("config", "camera", "imu", "focal_baseline", "is_map_fixed")
"""Those that are given before a state is read."""
_MOST_FRAMES = 1 << 53
"""Largest number of a frame: the path holds it as a double."""


def problem_of_state(held: dict[str, Any], system: Slam, num_lines: int) -> str:
    """What does not fit in the attributes of a `Slam` after so many frames; empty where all does.

    Its objects are as `state_tables` says, each by itself: here is what they say of each other.
    """
    try:
        return next(_problems(held, system, num_lines), "")
    except (KeyError, AttributeError, TypeError, ValueError, OverflowError, IndexError) as error:
        return f"its objects do not fit ({error})"


def _problems(held: dict[str, Any], system: Slam, num_lines: int) -> Iterator[str]:
    for name, kind in _KINDS.items():
        if not isinstance(held[name], kind) or isinstance(held[name], bool):
            yield f"{name} must be a {kind.__name__}"
    if any(held[name] != vars(system)[name] for name in _GIVEN):
        yield "it is of another run"
    if not held["_closer"].ledger is held["loops"] is system.loops:
        yield "it has another ledger of loops"
    yield from _of_numbers(held, num_lines)
    sensor = system.camera
    lens, maps, tracker = sensor.camera, held["maps"], held["tracker"]
    size = (lens.height, lens.width)
    if not any(held["map"] is one is tracker.map is held["mapper"].map for one in maps):
        yield "the map is none of the maps"
    for model in maps:
        if not isinstance(model, SlamMap):
            yield "a map is none"
        yield from _of_map(model, size)
    count = tracker.map.num_points
    for seen in [tracker.tracks, *tracker.waiting, *([] if tracker._seen is None else [tracker._seen])]:
        yield from _of_rows(seen.point, count, "a point is followed that is not there")
    yield from _of_rows(tracker.stale, count, "a point is stale that is not there")
    for hypothesis in held["_closer"]._waiting:
        if not any(hypothesis.there is one for one in maps) or hypothesis.keyframe < 0:
            yield "a loop leads to a map that is not there"
    if not isinstance(held["_before"], Frame | None) or not isinstance(held["_turning"], Turning | None):
        yield "the last frame is none"
    if not isinstance(held["_unconfirmed"], OneCameraStart | None):
        yield "the begin of the map is none"
    if not all(isinstance(words, str) for words in held["start_doubts"]):
        yield "a doubt is none"
    if held["_before"] is not None:
        yield from _of_frame(held["_before"], sensor)
    for start in (held["_start"], held["_unconfirmed"]):
        if start is not None:
            yield from _of_start(start, sensor)
    if held["_turning"] is not None:
        yield from _of_turning(held["_turning"], sensor)
    yield from _of_path(held["_path"], held["_num_frames"], num_lines)
    if not all(type(n) is int and isinstance(place, Rigid3) for n, place in held["_turns"].items()):
        yield "a direction is none"


def _of_numbers(held: dict[str, Any], num_lines: int) -> Iterator[str]:
    if not 0 <= held["_num_frames"] - held["first_number"] <= num_lines:
        yield "it has seen more frames than were followed"
    if not 0 <= held["first_number"] <= held["first_frame"] <= held["_num_frames"] <= _MOST_FRAMES:
        yield "the number of a frame is none"


def _of_map(model: SlamMap, size: tuple[int, int]) -> Iterator[str]:
    if len(model.xyz) != model.num_points or len(model._xyz) != model.num_points:
        yield "a map has another number of points"
    yield from _of_rows(model.anchor, len(model.keyframes), "a point has no keyframe")
    for keyframe in model.keyframes:
        yield from _of_keyframe(keyframe, model.num_points, size)


def _of_keyframe(keyframe: Keyframe, num_points: int, size: tuple[int, int]) -> Iterator[str]:
    if keyframe.grey.shape != size:
        yield "a keyframe's picture is of another size"
    if keyframe.look is not None and keyframe.look.size != look_size():
        yield "a keyframe's look is of another size"
    if not 0 <= keyframe.number <= _MOST_FRAMES or not 0 < keyframe.unit < np.inf:
        yield "a keyframe's number or unit is none"
    yield from _of_rows(keyframe.point, num_points, "a keyframe sees a point that is not there")


def _of_frame(frame: Frame, sensor: SlamCamera) -> Iterator[str]:
    try:
        sensor.checked(frame)
    except EpipoleError as error:
        yield f"a frame is not this camera's: {error}"


def _of_start(start: OneCameraStart, sensor: SlamCamera) -> Iterator[str]:
    count = start._num_at_start
    if not 0 <= count <= sensor.camera.width * sensor.camera.height:
        yield "more points are followed than a picture has"
    for rows in (start.tracks.point, *(one.track for one in start._waiting)):
        yield from _of_rows(rows, count, "a point is followed that is not there")
    for one in start._waiting:
        yield from _of_frame(one.frame, sensor)


def _of_turning(turning: Turning, sensor: SlamCamera) -> Iterator[str]:
    size, sphere = (sensor.camera.height, sensor.camera.width), turning._sphere
    yield from _of_map(sphere, size)
    yield from _of_rows(turning._tracks.point, sphere.num_points, "a direction is followed that is not there")
    yield from _of_frame(turning._before, sensor)
    for keyframe in turning.keyframes:
        yield from _of_keyframe(keyframe, 0, size)


def _of_path(path: Path, num_frames: int, num_lines: int) -> Iterator[str]:
    blocks = [*path._full, path._open]
    if any(len(rows) != BLOCK for rows in blocks) or not 0 <= num_frames - path.first <= num_lines:
        yield "the path is of another length"
    for rows in blocks:
        if (
            not (rows[:, KEYFRAME] < max(1, len(path._keyframes))).all()
            or not np.isfinite(rows[:, KEYFRAME]).all()
        ):
            yield "a frame has a keyframe that is not there"


def _of_rows(rows: np.ndarray, count: int, problem: str) -> Iterator[str]:
    if len(rows) and not 0 <= rows.min() <= rows.max() < count:
        yield problem
