"""Re-detection of map points in sight that are not tracked, by patches of older keyframes."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from epipole.cameras import Camera
from epipole.features.patches import find_patches
from epipole.geometry import Rigid3
from epipole.pipelines.slam.frames import is_outside
from epipole.pipelines.slam.map.slam_map import Keyframe, SlamMap
from epipole.pipelines.slam.tracking.patches import align_to_reference_patch, warps_between
from epipole.pipelines.slam.tracking.projection import centers_of, project_in_sight
from epipole.scene import CameraRig

RIM_PX = 5.0
"""Least distance of a point from the image's edges."""
MOST_KEYFRAMES = 4
LARGEST_SCALE, LEAST_COSINE = 1.6, math.cos(math.radians(35.0))
"""Limits of the change of scale and viewing direction beyond which patches do not match."""
HALF_PX = 10
LEAST_SCORE = 0.8
REACH_PX = 2.0
"""Search radius of a patch at full resolution."""
SEARCH_PX = 8.0
"""Largest distance of a re-detected point from its prediction while tracking."""
MOST_SEARCH_PX = 64.0
"""The same for an uncertain pose."""
DRIFT_PX = 25.0
"""The same when keyframes are linked, to cover drift."""


def redetect(
    model: SlamMap,
    camera: Camera | CameraRig,
    gray: np.ndarray,
    cam_from_world: Rigid3,
    tracked: np.ndarray,
    search_px: float = SEARCH_PX,
) -> tuple[np.ndarray, np.ndarray]:
    """(pixels, points) of points in sight that are not tracked, found by patches of the keyframes that observe most of them."""
    pixels, points = [np.zeros((0, 2))], [np.zeros(0, np.int64)]
    missing = np.isfinite(model.xyz[:, 0])
    missing[tracked] = False
    if not missing.any():
        return pixels[0], points[0]
    expected = np.full((model.num_points, 2), np.nan)
    rows = np.flatnonzero(missing)
    expected[rows], missing[rows] = project_in_sight(camera, cam_from_world.apply(model.xyz[rows]), RIM_PX)
    for keyframe, usable in _best_keyframes(model, camera, missing, cam_from_world, expected):
        own = usable[missing[keyframe.point[usable]]]
        own = own if isinstance(camera, Camera) else _one_of_each(keyframe, camera, own, expected)
        if len(own) < 5:
            continue
        at, wanted, xyz = keyframe.pixels[own], expected[keyframe.point[own]], model.xyz[keyframe.point[own]]
        then = [keyframe.cam_from_world]
        warps = warps_between(then, np.zeros(len(own), np.int64), at, xyz, camera, cam_from_world, wanted)
        levels = 1 + math.ceil(math.log2(search_px / REACH_PX))
        there, score = find_patches(keyframe.gray, gray, at, warps, wanted, levels, HALF_PX)
        found = (score >= LEAST_SCORE) & (np.linalg.norm(there - wanted, axis=1) <= search_px)
        pixels.append(there[found])
        points.append(keyframe.point[own[found]])
        missing[points[-1]] = False
    return np.concatenate(pixels), np.concatenate(points)


def _one_of_each(keyframe: Keyframe, rig: CameraRig, own: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """One observation of each point, in the camera where the point is expected if that one has seen it."""
    point = keyframe.point[own]
    is_other = rig.camera_of(keyframe.pixels[own]) != rig.camera_of(expected[point])
    order = np.argsort(is_other, kind="stable")
    _, first = np.unique(point[order], return_index=True)
    return own[np.sort(order[first])]


def search_radius(
    model: SlamMap, camera: Camera | CameraRig, cam_from_world: Rigid3, covariance: np.ndarray
) -> float:
    """Three standard deviations of the pixels of points in sight, for a pose with this covariance; limited."""
    in_body = cam_from_world.apply(model.xyz[np.isfinite(model.xyz[:, 0])])
    depth = np.linalg.norm(in_body, axis=1) if isinstance(camera, CameraRig) else in_body[:, 2]
    near = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
    shift, rotation = (
        math.sqrt(np.linalg.eigvalsh(part)[-1]) for part in (covariance[:3, :3], covariance[3:, 3:])
    )
    return float(
        np.clip(3.0 * camera.focal_px * math.hypot(shift / near, rotation), SEARCH_PX, MOST_SEARCH_PX)
    )


def _best_keyframes(
    model: SlamMap,
    camera: Camera | CameraRig,
    missing: np.ndarray,
    cam_from_world: Rigid3,
    expected: np.ndarray,
) -> list[tuple[Keyframe, np.ndarray]]:
    """The keyframes with most usable observations of missing points, and these; best first.

    A keyframe has at most as many usable observations as observations, so that most need not be examined.
    """
    keyframes = model.keyframes
    rotations = np.stack([k.cam_from_world.rotation for k in keyframes])
    # The trace of a rotation is 1 + 2 cos of its angle.
    is_near = np.einsum("ij,kij->k", cam_from_world.rotation, rotations) >= 1 + 2 * LEAST_COSINE
    if isinstance(camera, CameraRig):
        is_near[:] = True  # a camera may see what another one has seen, whatever the rig's rotation
    most = np.array([np.count_nonzero(missing[k.point]) for k in keyframes]) * is_near
    count, views = np.zeros(max(len(keyframes), MOST_KEYFRAMES), np.int64), {}
    for index in np.argsort(-most, kind="stable").tolist():
        if most[index] < max(1, np.partition(count, -MOST_KEYFRAMES)[-MOST_KEYFRAMES]):
            break
        views[index] = _usable(keyframes[index], model, camera, missing, cam_from_world, expected)
        count[index] = len(views[index])
    best = np.argsort(-count, kind="stable")[:MOST_KEYFRAMES].tolist()
    return [(keyframes[index], views[index]) for index in best if index in views]


def _usable(
    keyframe: Keyframe,
    model: SlamMap,
    camera: Camera | CameraRig,
    missing: np.ndarray,
    cam_from_world: Rigid3,
    expected: np.ndarray,
) -> np.ndarray:
    """Observations of missing points from a similar distance and direction."""
    own = np.flatnonzero(missing[keyframe.point])
    if not len(own):
        return own
    xyz = model.xyz[keyframe.point[own]]
    there = xyz - centers_of(camera, keyframe.cam_from_world, keyframe.pixels[own])
    here = xyz - centers_of(camera, cam_from_world, expected[keyframe.point[own]])
    far, near = np.linalg.norm(there, axis=1), np.linalg.norm(here, axis=1)
    cosine = (there * here).sum(axis=1) / np.maximum(far * near, 1e-12)
    ratio = near / np.maximum(far, 1e-12)
    return own[(cosine > LEAST_COSINE) & (ratio < LARGEST_SCALE) & (ratio > 1 / LARGEST_SCALE)]


def link_tracks(model: SlamMap, camera: Camera | CameraRig, keyframes: Iterable[Keyframe]) -> int:
    """Add observations of all map points in sight of the keyframes; returns their number.

    The search radius is larger than during tracking, to find points despite drift.
    """
    count = 0
    for keyframe in keyframes:
        position = keyframe.cam_from_world
        pixels, points = redetect(model, camera, keyframe.gray, position, keyframe.point, DRIFT_PX)
        if not len(points):
            continue
        pixels, is_same, is_stale = align_to_reference_patch(
            model, camera, keyframe.gray, position, points, pixels
        )
        good = is_same & ~is_stale & is_outside(keyframe.ignored_mask, pixels)
        keyframe.add(pixels[good], np.full(int(good.sum()), np.nan), points[good])
        count += int(good.sum())
    return count
