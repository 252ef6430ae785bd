"""The begin of one camera's map: it is adjusted, made straight where rows are read one after another, and its frames get places."""

from __future__ import annotations

import numpy as np

from epipole.geometry import Rigid3
from epipole.pipelines.slam.map.local_mapping import LocalMapper
from epipole.pipelines.slam.map.slam_map import Keyframe
from epipole.pipelines.slam.shutter.motion import SETTLED_SIGMA, refine_while_moving
from epipole.pipelines.slam.shutter.recent_motion import AROUND, NO_MOTION, motion_among
from epipole.pipelines.slam.start.two_view import Initialization, place_in_map

ROUNDS = 4
"""Motions follow from the map, and the map from the motions."""


def bootstrap_map(
    mapper: LocalMapper, begun: Initialization
) -> list[tuple[int, float, Keyframe, Rigid3, np.ndarray]]:
    """Adjust a map that has just begun, and make the median depth of its first points the unit.

    Args:
        mapper: of the map, with the present frame as its newest keyframe.
        begun: the frames before it.

    Returns:
        of these: number, time, keyframe, cam_from_world and covariance.
    """
    model = mapper.map
    mapper.adjust_all()
    places = _straighten(mapper, begun) if mapper.sensor.readout_s else {}
    first = next(k for k in model.keyframes if k.number == begun.waiting[0].number)
    unit = 1.0 / float(np.nanmedian(first.cam_from_world.apply(model.xyz[begun.tracks.point])[:, 2]))
    model.rescale(unit)
    out = []
    for one, keyframe, place, covariance in begun.place_waiting(model, mapper.camera, mapper.config):
        straight = places.get(one.frame.timestamp_s)
        if straight is not None and keyframe.number != one.number:
            place = Rigid3(straight.rotation, unit * straight.translation)
        out.append((one.number, one.frame.timestamp_s, keyframe, place, covariance))
    return out


def _straighten(mapper: LocalMapper, begun: Initialization) -> dict[float, Rigid3]:
    """Adjust the map with its keyframes' motions by all frames up to its begin; cam_from_world of these, by their times.

    The first pictures bend the map, and the map the places of the frames, but all alike: the motion between them is nearly right.
    """
    model, motions = mapper.map, dict[float, np.ndarray]()
    for _ in range(ROUNDS):
        motions = _motions(_places(mapper, begun, motions))
        for keyframe in model.keyframes:
            keyframe.motion = motions.get(keyframe.timestamp_s, NO_MOTION)
        mapper.adjust_all()
    places = _places(mapper, begun, motions)
    for time, before, now in zip(list(places)[1:], places.values(), list(places.values())[1:]):
        depth = float(np.nanmedian(now.apply(model.xyz)[:, 2]))
        model.recent = model.recent.with_step(time, now @ before.inverse(), depth).begin_at(time)
    model.motion = model.keyframes[-1].motion
    return places


def _motions(places: dict[float, Rigid3]) -> dict[float, np.ndarray]:
    """(12,) of each frame by those around it."""
    times, there = np.array(list(places)), list(places.values())
    if len(times) < 2:
        return {}
    cams = Rigid3(np.stack([p.rotation for p in there]), np.stack([p.translation for p in there]))
    out = {}
    for n, time in enumerate(times):
        first = min(max(n - AROUND // 2, 0), max(len(times) - AROUND, 0))
        near = slice(first, first + AROUND)
        out[float(time)] = motion_among(times[near], cams[near], n - first)
    return out


def _places(
    mapper: LocalMapper, begun: Initialization, motions: dict[float, np.ndarray]
) -> dict[float, Rigid3]:
    """cam_from_world of the frames before the begin, and of its own, by their times."""
    model, camera = mapper.map, mapper.camera
    newest = model.keyframes[-1]
    seen = [(one.frame.timestamp_s, *begun.seen_by(one)) for one in begun.waiting]
    out, start = {}, model.keyframes[0].cam_from_world
    for time, pixels, rows in [*seen, (newest.timestamp_s, newest.pixels, newest.point)]:
        found = place_in_map(model, rows, pixels, start, camera, mapper.config)
        if found is None:
            continue
        out[time] = start = found.cam_from_world
        if time in motions:
            kept = model.is_triangulated(rows)
            known = camera, start, motions[time], mapper.sensor.readout_s
            out[time], _, _ = refine_while_moving(
                model.xyz[rows[kept]], pixels[kept], *known, sigma=SETTLED_SIGMA
            )
    return out
