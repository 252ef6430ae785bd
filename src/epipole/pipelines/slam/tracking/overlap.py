"""Points that several cameras of a rig see at the same instant."""

from __future__ import annotations

import math

import numpy as np

from epipole.features import describe_upright
from epipole.features.patches import find_patches
from epipole.geometry import Rigid3
from epipole.pipelines.slam.tracking.patches import warps_between
from epipole.pipelines.slam.tracking.projection import SEAM_PX
from epipole.pipelines.slam.tracking.redetection import HALF_PX, LEAST_SCORE, REACH_PX, SEARCH_PX
from epipole.scene import CameraRig

EPIPOLAR_PX = 2.0
"""Largest distance of a match from its epipolar plane."""
LEAST_DEPTH = 1.0
"""Smallest depth of a match, in distances between the two cameras: nearer, patches look too different."""
SIGMA_PX = 5.0
"""Scale of the descriptors in the camera with the widest view."""
LARGEST_RATIO = 0.8
"""Largest ratio of the descriptor distances of the best and the second best match (Lowe 2004)."""
LARGEST_DISTANCE = 250.0
"""Largest distance of matching descriptors, whose length is 512."""


def find_in_other_cameras(
    rig: CameraRig,
    gray: np.ndarray,
    rig_from_world: Rigid3,
    pixels: np.ndarray,
    points_in_world: np.ndarray,
    point: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Triangulated points in the images of the other cameras that should see them, by their patches.

    Args:
        rig: the cameras.
        gray: the stacked image.
        rig_from_world: pose.
        pixels: (n, 2) observations.
        points_in_world: (n, 3); NaN if not triangulated.
        point: (n,) their rows, or other labels; the same for the same point.

    Returns:
        (m, 2) pixels and (m,) labels of the added observations.
    """
    found_px, found_point = [np.zeros((0, 2))], [np.zeros(0, np.int64)]
    which, in_rig = rig.camera_of(pixels), rig_from_world.apply(points_in_world)
    known = np.isfinite(in_rig[:, 0])
    for k in range(len(rig.cameras)):
        lacking = known & (which != k) & ~np.isin(point, point[which == k])
        _, first = np.unique(np.where(lacking, point, -(2**62)), return_index=True)
        rows = first[lacking[first]]
        camera = np.full(len(rows), k)
        wanted = rig.project(in_rig[rows], camera)
        rows, wanted = (x[rig.sees(wanted, camera, SEAM_PX)] for x in (rows, wanted))
        if not len(rows):
            continue
        same, at = np.zeros(len(rows), np.int64), pixels[rows]
        warps = warps_between([rig_from_world], same, at, points_in_world[rows], rig, rig_from_world, wanted)
        levels = 1 + math.ceil(math.log2(SEARCH_PX / REACH_PX))
        there, score = find_patches(gray, gray, at, warps, wanted, levels, HALF_PX)
        near = np.linalg.norm(there - wanted, axis=1) <= SEARCH_PX
        good = (score >= LEAST_SCORE) & near & rig.sees(there, camera[: len(rows)], SEAM_PX)
        found_px.append(there[good])
        found_point.append(point[rows[good]])
    return np.concatenate(found_px), np.concatenate(found_point)


def match_between_cameras(rig: CameraRig, gray: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(m, 2) pairs of pixels (indices, in increasing order) in two cameras that show the same point, by their descriptors.

    A match is near its epipolar plane and in front of both cameras. Each pixel is in at most one pair.
    """
    which = rig.camera_of(pixels)
    descriptors = _described(rig, gray, pixels, which)
    described, common = descriptors.any(axis=1), rig.common_views()
    pairs, taken = [np.zeros((0, 2), np.int64)], np.zeros(len(pixels), bool)
    for k, other in zip(*np.nonzero(np.triu(common + common.T, 1))):
        one = np.flatnonzero((which == k) & described & ~taken)
        two = np.flatnonzero((which == other) & described & ~taken)
        if not len(one) or len(two) < 2:
            continue
        rays = tuple(rig.unproject(pixels[rows], which[rows]) for rows in (one, two))
        possible = _may_match(rays, rig.cam_from_rig[other] @ rig.cam_from_rig[k].inverse(), rig.focal_px)
        first, second = _best_of_both(descriptors[one], descriptors[two], possible)
        pairs.append(np.sort(np.column_stack([one[first], two[second]]), axis=1))
        taken[pairs[-1].ravel()] = True
    return np.concatenate(pairs)


def _described(rig: CameraRig, gray: np.ndarray, pixels: np.ndarray, which: np.ndarray) -> np.ndarray:
    """(n, 128) descriptors of windows that show the same angle in all cameras."""
    focal_px = np.array([camera.focal_px for camera in rig.cameras])
    descriptors = np.zeros((len(pixels), 128), np.float32)
    sigma_px = SIGMA_PX * focal_px / focal_px.min()
    for one in np.unique(sigma_px):
        own = sigma_px[which] == one
        descriptors[own] = describe_upright(gray, pixels[own], float(one))
    return descriptors


def _may_match(rays: tuple[np.ndarray, ...], second_from_first: Rigid3, focal_px: float) -> np.ndarray:
    """(n, m) whether two rays may meet: near a common plane with the baseline, in front of both cameras."""
    first, second = rays[0] @ second_from_first.rotation.T, rays[1]
    baseline = second_from_first.translation
    normal = np.cross(baseline, first)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    off = np.abs(normal @ second.T) * focal_px
    # Depths a, b of a * first + baseline = b * second, from the normal equations.
    cosine = first @ second.T
    along_first, along_second = first @ baseline, second @ baseline
    squared_sine = np.maximum(1.0 - cosine**2, 1e-12)
    a = (cosine * along_second[None] - along_first[:, None]) / squared_sine
    b = (along_second[None] - cosine * along_first[:, None]) / squared_sine
    least = LEAST_DEPTH * float(np.linalg.norm(baseline))
    return (off <= EPIPOLAR_PX) & (a > least) & (b > least)


def _best_of_both(one: np.ndarray, two: np.ndarray, possible: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the mutually best matches that are clearly better than the second best."""
    squared = (one**2).sum(axis=1)[:, None] + (two**2).sum(axis=1)[None] - 2.0 * one @ two.T
    distance = np.where(possible, np.sqrt(np.maximum(squared, 0.0)), np.inf)
    best = distance.argmin(axis=1)
    ranked = np.partition(distance, 1, axis=1)
    rows = np.arange(len(one))
    with np.errstate(invalid="ignore"):
        good = (ranked[:, 0] <= LARGEST_DISTANCE) & ~(ranked[:, 0] > LARGEST_RATIO * ranked[:, 1])
    good &= distance.argmin(axis=0)[best] == rows
    return rows[good], best[good]
