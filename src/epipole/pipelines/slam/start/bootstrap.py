"""First adjustment of a single camera's map, with rolling-shutter correction and the poses of the frames so far."""

from __future__ import annotations

import numpy as np

from epipole.geometry import Rigid3
from epipole.pipelines.slam.map.local_mapping import LocalMapper
from epipole.pipelines.slam.map.slam_map import Keyframe
from epipole.pipelines.slam.shutter.recent_motion import AROUND, NO_MOTION, motion_among
from epipole.pipelines.slam.shutter.shutter import CONVERGED_SIGMA
from epipole.pipelines.slam.start.one_camera import Initialization, initialize_map

ROUNDS = 4
"""Alternations between the map and the motions of its frames."""


def bootstrap_map(
    mapper: LocalMapper, initial: Initialization
) -> list[tuple[int, float, Keyframe, Rigid3, np.ndarray]]:
    """Adjust a new map and scale it to a median depth of 1 of its first points.

    Args:
        mapper: of the map, with the present frame as its newest keyframe.
        initial: the frames before it.

    Returns:
        number, time, keyframe, cam_from_world and covariance of each of these frames.
    """
    model = mapper.map
    mapper.adjust_all()
    positions = _straighten(mapper, initial) if mapper.sensor.shutter.is_rolling else {}
    first = next(k for k in model.keyframes if k.number == initial.waiting[0].number)
    unit = 1.0 / float(np.nanmedian(first.cam_from_world.apply(model.xyz[initial.tracks.point])[:, 2]))
    model.rescale(unit)
    out = []
    for one, keyframe, position, covariance in initial.locate_waiting(
        model, mapper.sensor.camera, mapper.config
    ):
        straight = positions.get(one.frame.timestamp_s)
        if straight is not None and keyframe.number != one.number:
            position = Rigid3(straight.rotation, unit * straight.translation)
        out.append((one.number, one.frame.timestamp_s, keyframe, position, covariance))
    return out


def _straighten(mapper: LocalMapper, initial: Initialization) -> dict[float, Rigid3]:
    """Adjust the map with the rolling-shutter motions of its keyframes; returns cam_from_world of all frames so far, by time.

    The rolling shutter distorts the map and the poses alike, so the motion between frames is nearly right from the start.
    """
    model, motions = mapper.map, dict[float, np.ndarray]()
    for _ in range(ROUNDS):
        motions = _motions(_positions(mapper, initial, motions))
        for keyframe in model.keyframes:
            keyframe.motion = motions.get(keyframe.timestamp_s, NO_MOTION)
        mapper.adjust_all()
    positions = _positions(mapper, initial, motions)
    for time, before, now in zip(list(positions)[1:], positions.values(), list(positions.values())[1:]):
        depth = float(np.nanmedian(now.apply(model.xyz)[:, 2]))
        model.recent = model.recent.with_step(time, now @ before.inverse(), depth).start_at(time)
    model.motion = model.keyframes[-1].motion
    return positions


def _motions(positions: dict[float, Rigid3]) -> dict[float, np.ndarray]:
    """(12,) motion of each frame, by time, from the frames around it."""
    times, there = np.array(list(positions)), list(positions.values())
    if len(times) < 2:
        return {}
    cams = Rigid3(np.stack([p.rotation for p in there]), np.stack([p.translation for p in there]))
    out = {}
    for n, time in enumerate(times):
        first = min(max(n - AROUND // 2, 0), max(len(times) - AROUND, 0))
        near = slice(first, first + AROUND)
        out[float(time)] = motion_among(times[near], cams[near], n - first)
    return out


def _positions(
    mapper: LocalMapper, initial: Initialization, motions: dict[float, np.ndarray]
) -> dict[float, Rigid3]:
    """cam_from_world, by time, of the waiting frames and of the newest keyframe."""
    model, camera = mapper.map, mapper.sensor.camera
    newest = model.keyframes[-1]
    seen = [(one.frame.timestamp_s, *initial.seen_by(one)) for one in initial.waiting]
    out, start = {}, model.keyframes[0].cam_from_world
    for time, pixels, rows in [*seen, (newest.timestamp_s, newest.pixels, newest.point)]:
        found = initialize_map(model, rows, pixels, start, camera, mapper.config)
        if found is None:
            continue
        out[time] = start = found.cam_from_world
        if time in motions:
            kept = model.is_triangulated(rows)
            xyz, motion = model.xyz[rows[kept]], motions[time]
            out[time], _, _ = mapper.sensor.shutter.refine(
                xyz, pixels[kept], start, motion, sigma=CONVERGED_SIGMA
            )
    return out
