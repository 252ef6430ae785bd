"""Triangulation of points tracked by one camera, from keyframes and from the frames between them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.frames import SlamCamera
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.tracking.points import Tracks
from epipole.robust import triangulate_points
from epipole.scene import CameraRig


def triangulate(model: SlamMap, camera: Camera | CameraRig, config: OdometryConfig, newest: int) -> int:
    """Triangulate the remaining points of the newest keyframe; returns their number."""
    keyframe = model.keyframes[newest]
    points = keyframe.point[~model.is_triangulated(keyframe.point)]
    if not len(points):
        return 0
    column = np.full(model.num_points, -1)
    column[points] = np.arange(len(points))
    positions, cameras, rows = [], [], []
    for k in range(max(0, newest - 20), newest + 1):
        own = model.keyframes[k]
        seen = column[own.point]
        for one, position, pixels, mask in views_of(camera, own.cam_from_world, own.straight_px, seen >= 0):
            row = np.full((len(points), 2), np.nan)
            row[seen[mask]] = pixels
            positions.append(position)
            cameras.append(one)
            rows.append(row)
    if len(rows) < 2:
        return 0
    found = triangulate_points(
        Rigid3(np.stack([p.rotation for p in positions]), np.stack([p.translation for p in positions])),
        cameras if isinstance(camera, CameraRig) else camera,
        np.stack(rows),
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
    points, camera, count = tracks.point, sensor.camera_or_rig, 0
    lacking = ~model.is_triangulated(points)
    for k in np.unique(model.anchor[points[lacking]]):
        there, own = model.keyframes[int(k)].cam_from_world, lacking & (model.anchor[points] == k)
        then_px = model.anchor_px[points]
        for one, then, pixels_then, first in views_of(camera, there, then_px, own):
            for other, now, pixels, mask in views_of(camera, cam_from_world, tracks.pixels, first):
                two = Rigid3(
                    np.stack([then.rotation, now.rotation]), np.stack([then.translation, now.translation])
                )
                found = triangulate_points(
                    two,
                    (one, other) if isinstance(camera, CameraRig) else one,
                    np.stack([pixels_then[mask[first]], pixels]),
                    max_error_px=1.0,
                    min_angle_rad=np.deg2rad(config.triangulation_angle_deg),
                )
                good = found.success_mask
                model.xyz[points[mask][good]] = found.points_in_world[good]
                count += int(good.sum())
    return count


def views_of(
    camera: Camera | CameraRig, body_from_world: Rigid3, pixels: np.ndarray, mask: np.ndarray
) -> Iterator[tuple[Camera, Rigid3, np.ndarray, np.ndarray]]:
    """For every camera with masked pixels: the camera, cam_from_world, its own masked pixels, and their mask (n,)."""
    if not mask.any():
        return
    if not isinstance(camera, CameraRig):
        yield camera, body_from_world, pixels[mask], mask
        return
    which = camera.camera_of(pixels)
    for k in np.unique(which[mask]):
        own = mask & (which == k)
        local = pixels[own] - [0.0, float(camera.tops[k])]
        yield camera.cameras[k], camera.cam_from_rig[k] @ body_from_world, local, own


def positions_of(model: SlamMap, keyframes: Iterable[int]) -> Rigid3:
    """cam_from_world of keyframes."""
    positions = [model.keyframes[k].cam_from_world for k in keyframes]
    return Rigid3(np.stack([p.rotation for p in positions]), np.stack([p.translation for p in positions]))
