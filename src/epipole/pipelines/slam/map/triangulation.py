"""Triangulation of points tracked by one camera, from keyframes and from the frames between them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.frames import SlamCamera
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.tracking.points import Tracks
from epipole.robust import triangulate_points


def triangulate(model: SlamMap, camera: Camera, config: OdometryConfig, newest: int) -> int:
    """Triangulate the remaining points of the newest keyframe; returns their number."""
    keyframe = model.keyframes[newest]
    points = keyframe.point[~model.is_triangulated(keyframe.point)]
    if not len(points):
        return 0
    column = np.full(model.num_points, -1)
    column[points] = np.arange(len(points))
    views = [
        k for k in range(max(0, newest - 20), newest + 1) if (column[model.keyframes[k].point] >= 0).any()
    ]
    pixels = np.full((len(views), len(points), 2), np.nan)
    for v, k in enumerate(views):
        own = model.keyframes[k]
        seen = column[own.point]
        pixels[v, seen[seen >= 0]] = own.straight_px[seen >= 0]
    if len(views) < 2:
        return 0
    found = triangulate_points(
        positions_of(model, views),
        camera,
        pixels,
        max_error_px=config.max_error_px,
        min_angle_rad=np.deg2rad(config.min_angle_deg),
    )
    good = found.success_mask
    model.xyz[points[good]] = found.points_in_world[good]
    return int(good.sum())


def triangulate_between_keyframes(
    model: SlamMap, sensor: SlamCamera, config: OdometryConfig, cam_from_world: Rigid3, tracks: Tracks
) -> int:
    """Triangulate tracked points from their anchor keyframes and a frame with a known pose; returns their number.

    The next keyframe would be too late: a fast camera runs out of points before.
    """
    if sensor.shutter.is_rolling:
        return 0  # the rolling-shutter correction is known in keyframes only
    points, pixels = tracks.point, tracks.pixels
    lacking = np.flatnonzero(~model.is_triangulated(points))
    anchors, count = model.anchor[points[lacking]], 0
    for k in np.unique(anchors):
        rows = lacking[anchors == k]
        there = model.keyframes[int(k)].cam_from_world
        two = Rigid3(
            np.stack([there.rotation, cam_from_world.rotation]),
            np.stack([there.translation, cam_from_world.translation]),
        )
        found = triangulate_points(
            two,
            sensor.camera,
            np.stack([model.anchor_px[points[rows]], pixels[rows]]),
            max_error_px=1.0,
            min_angle_rad=np.deg2rad(config.triangulation_angle_deg),
        )
        good = found.success_mask
        model.xyz[points[rows[good]]] = found.points_in_world[good]
        count += int(good.sum())
    return count


def positions_of(model: SlamMap, keyframes: Iterable[int]) -> Rigid3:
    """cam_from_world of keyframes."""
    positions = [model.keyframes[k].cam_from_world for k in keyframes]
    return Rigid3(np.stack([p.rotation for p in positions]), np.stack([p.translation for p in positions]))
