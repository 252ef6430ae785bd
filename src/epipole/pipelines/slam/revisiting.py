"""Points of the map that should be in sight, but are not followed: found again by the pictures of older keyframes."""

from __future__ import annotations

import numpy as np

from epipole.cameras import Camera
from epipole.features.flow import follow_points
from epipole.geometry import Rigid3
from epipole.pipelines.slam.anchoring import hold
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.slam_map import Keyframe, SlamMap

MOST_KEYFRAMES = 4
LARGEST_TURN_DEG, LARGEST_SCALE = 25.0, 1.35
"""Beyond, a patch of the older picture does not look like the new one's."""
SEARCH_PX, DRIFT_PX = 8.0, 25.0
"""How far from where the map says a point may be found: at once, and after the last frame."""


def find_again(
    model: SlamMap,
    camera: Camera,
    grey: np.ndarray,
    cam_from_world: Rigid3,
    followed: np.ndarray,
    config: SlamConfig,
    search_px: float = SEARCH_PX,
) -> tuple[np.ndarray, np.ndarray]:
    """(pixels, points) of points that are in sight and not followed, by patches of the keyframes that see most of them."""
    missing = np.isfinite(model.xyz[:, 0])
    missing[followed] = False
    expected = np.full((model.num_points, 2), np.nan)
    rows = np.flatnonzero(missing)
    in_cam = cam_from_world.apply(model.xyz[rows])
    expected[rows] = camera.project(in_cam)
    inside = (expected[rows] >= 5).all(axis=1) & (expected[rows] < [camera.width - 5, camera.height - 5]).all(
        axis=1
    )
    missing[rows] = inside & (in_cam[:, 2] > 0)
    views = [_usable(k, model, missing, cam_from_world) for k in model.keyframes]
    pixels, points = [np.zeros((0, 2))], [np.zeros(0, np.int64)]
    for index in np.argsort([-len(v) for v in views], kind="stable")[:MOST_KEYFRAMES]:
        keyframe, own = model.keyframes[int(index)], views[int(index)]
        own = own[missing[keyframe.point[own]]]
        if len(own) < 5:
            continue
        wanted = expected[keyframe.point[own]]
        there, found = follow_points(keyframe.grey, grey, keyframe.pixels[own], wanted, config.flow)
        found &= np.linalg.norm(there - wanted, axis=1) <= search_px
        pixels.append(there[found])
        points.append(keyframe.point[own[found]])
        missing[points[-1]] = False
    return np.concatenate(pixels), np.concatenate(points)


def _usable(keyframe: Keyframe, model: SlamMap, missing: np.ndarray, cam_from_world: Rigid3) -> np.ndarray:
    """Observations of missing points that a like view of the scene made: as near, and from as much the same side."""
    own = np.flatnonzero(missing[keyframe.point])
    if not len(own):
        return own
    relative = cam_from_world.rotation @ keyframe.cam_from_world.rotation.T
    if np.degrees(np.arccos(np.clip((np.trace(relative) - 1) / 2, -1, 1))) > LARGEST_TURN_DEG:
        return own[:0]
    there = model.xyz[keyframe.point[own]] - keyframe.cam_from_world.inverse().translation
    here = model.xyz[keyframe.point[own]] - cam_from_world.inverse().translation
    far, near = np.linalg.norm(there, axis=1), np.linalg.norm(here, axis=1)
    cosine = (there * here).sum(axis=1) / np.maximum(far * near, 1e-12)
    ratio = near / np.maximum(far, 1e-12)
    fits = (
        (cosine > np.cos(np.radians(LARGEST_TURN_DEG)))
        & (ratio < LARGEST_SCALE)
        & (ratio > 1 / LARGEST_SCALE)
    )
    return own[fits]


def tie_together(model: SlamMap, camera: Camera, config: SlamConfig) -> int:
    """Let every keyframe see all points of the map that are in its picture; returns the number of new observations.

    While the camera moves a point is looked for near its place alone; here also where drift has moved it to.
    """
    count = 0
    for keyframe in model.keyframes:
        place = keyframe.cam_from_world
        pixels, points = find_again(model, camera, keyframe.grey, place, keyframe.point, config, DRIFT_PX)
        if not len(points):
            continue
        pixels, is_same, is_stale = hold(model, camera, keyframe.grey, place, points, pixels)
        good = is_same & ~is_stale
        keyframe.add(pixels[good], np.full(int(good.sum()), np.nan), points[good])
        count += int(good.sum())
    return count
