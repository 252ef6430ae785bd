"""Alignment of tracked points to their reference patches, so that tracking does not drift."""

from __future__ import annotations

import numpy as np

from epipole.cameras import Camera
from epipole.features.patches import align_patches_of_images
from epipole.geometry import Rigid3
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.tracking.projection import depth_of, points_at_depth, project_as
from epipole.scene import CameraRig

STEP_PX = 4.0
"""Half the distance over which the warp of a patch is measured."""
STEPS_PX = STEP_PX * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
BENT_STEPS_PX = STEP_PX * np.array(
    [[1, 0], [-1, 0], [0, 1], [0, -1], [0, 0], [1, 1], [-1, -1], [1, -1], [-1, 1.0]]
)
"""The same, with the steps for second derivatives."""
LEAST_SCORE = 0.6
FURTHEST_PX = 4.0
LARGEST_SCALE, LEAST_FRESH_SCORE = 1.8, 0.65
"""Limits beyond which the reference patch of a point is replaced by the present one."""


def align_to_reference_patch(
    model: SlamMap,
    camera: Camera | CameraRig,
    gray: np.ndarray,
    cam_from_world: Rigid3,
    points: np.ndarray,
    pixels: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Refine pixels of points by aligning the present image to the patches in which they were first seen.

    Args:
        model: the map.
        camera: any model.
        gray: the present image.
        cam_from_world: its approximate pose.
        points: (n,) rows of the map.
        pixels: (n, 2) predicted, to a few pixels.

    Returns:
        Pixels; a mask of those whose patch correlates; a mask of those whose reference patch should be replaced.
    """
    anchors, which = np.unique(model.anchor[points], return_inverse=True)
    keyframes = [model.keyframes[int(k)] for k in anchors]
    then, anchor_px = [k.cam_from_world for k in keyframes], model.anchor_px[points]
    warps = warps_between(then, which, anchor_px, model.xyz[points], camera, cam_from_world, pixels)
    images = [k.gray for k in keyframes]
    out, score = align_patches_of_images(images, which, gray, anchor_px, warps, pixels)
    near = np.linalg.norm(out - pixels, axis=1) <= FURTHEST_PX
    is_same = (score >= LEAST_SCORE) & near
    scale = np.sqrt(np.abs(np.linalg.det(warps[..., :2])))
    is_stale = (scale > LARGEST_SCALE) | (scale < 1 / LARGEST_SCALE) | (score < LEAST_FRESH_SCORE)
    # A patch at the image border cannot be compared: keep the tracked pixel.
    return np.where(is_same[:, None], out, pixels), is_same | np.isnan(score), is_stale


def warps_between(
    then: list[Rigid3],
    which: np.ndarray,
    pixels: np.ndarray,
    points_in_world: np.ndarray,
    camera: Camera | CameraRig,
    cam_from_world: Rigid3,
    pixels_now: np.ndarray,
) -> np.ndarray:
    """(n, 2, 2) d(pixel now) / d(pixel then), for patches that faced the camera then; for a rig (n, 2, 5), with second derivatives.

    Two cameras of a rig see a point at different angles from their axes, which bends its patch.

    Args:
        then: cam_from_world of other images.
        which: (n,) index into `then`.
        pixels: (n, 2) in those images.
        points_in_world: (n, 3); for NaN the median depth of the others is used.
        camera: any model.
        cam_from_world: of the present image.
        pixels_now: (n, 2) expected in the present image.
    """
    is_bent = isinstance(camera, CameraRig)
    steps, out = BENT_STEPS_PX if is_bent else STEPS_PX, np.zeros((len(pixels), 2, 5 if is_bent else 2))
    out[:, [0, 1], [0, 1]] = 1.0
    if not len(pixels):
        return out
    there = Rigid3(np.stack([p.rotation for p in then]), np.stack([p.translation for p in then]))
    motion = cam_from_world @ there.inverse()
    in_body = np.einsum("nij,nj->ni", there.rotation[which], points_in_world) + there.translation[which]
    in_cam = depth_of(camera, in_body, pixels)
    known = in_cam > 0
    depth = np.where(known, in_cam, np.median(in_cam[known]) if known.any() else 1.0)
    num, ends = len(steps), (pixels + steps[:, None]).reshape(-1, 2)
    patches = points_at_depth(camera, ends, np.tile(depth, num), np.tile(pixels, (num, 1)))
    moved = np.einsum("nij,snj->sni", motion.rotation[which], patches.reshape(num, -1, 3))
    moved += motion.translation[which]
    seen = project_as(camera, moved.reshape(-1, 3), np.tile(pixels_now, (num, 1))).reshape(num, -1, 2)
    columns = [(seen[0] - seen[1]) / (2 * STEP_PX), (seen[2] - seen[3]) / (2 * STEP_PX)]
    if is_bent:
        mixed = 0.25 * (seen[5] + seen[6] - seen[7] - seen[8])
        for second in (seen[0] + seen[1] - 2.0 * seen[4], mixed, seen[2] + seen[3] - 2.0 * seen[4]):
            columns.append(second / STEP_PX**2)
    warps = np.stack(columns, axis=2)
    good = np.isfinite(warps).all(axis=(1, 2))
    return np.where(good[:, None, None], warps, out)
