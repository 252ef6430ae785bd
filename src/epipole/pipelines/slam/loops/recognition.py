"""Relocalization of an image in a map: similar images, matching points, and the pose from them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from epipole.cameras import Camera
from epipole.config import MatchConfig, RansacConfig
from epipole.features import describe_image, describe_upright, match_descriptors
from epipole.geometry import Rigid3
from epipole.mapping import refine_pose
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.map.slam_map import Keyframe, SlamMap
from epipole.pipelines.slam.tracking.patches import align_to_reference_patch
from epipole.pipelines.slam.tracking.pose_search import search_pose
from epipole.pipelines.slam.tracking.projection import project_as, project_in_sight
from epipole.scene import CameraRig

WORDS = Path(__file__).parent / "assets" / "words.npy"
NEIGHBORS = 3
"""Neighbors of a similar keyframe whose points are compared too."""
MIN_SAMPLE = 12
"""Fewest inliers among the matches."""
MIN_FRACTION = 0.25
"""Smallest fraction of inliers among the matches; chance matches reach less."""
SAME_POSITION_PX, RIVAL_FRACTION = 12.0, 0.6
ROUNDS, RIM_PX = 2, 5.0
MIN_AGREEING = 30
"""Fewest inliers after the search of all points in sight at the pose."""


class View(NamedTuple):
    """A described image."""

    gray: np.ndarray
    pixels: np.ndarray  # (n, 2)
    descriptors: np.ndarray  # (n, 128)
    descriptor: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Recognition:
    """Result of matching an image to a keyframe."""

    keyframe: int
    """Index of the keyframe."""
    num_matches: int
    reason: str
    """Why the image does not match; empty if it does."""
    cam_from_world: Rigid3
    pixels: np.ndarray
    """(n, 2) of the inliers."""
    points: np.ndarray
    """(n,) their rows in the map."""


@cache
def _words() -> np.ndarray:
    return np.load(WORDS).astype(np.float32)


def descriptor_size() -> int:
    """Length of an image's global descriptor."""
    return _words().size


def view_of(gray: np.ndarray, pixels: np.ndarray) -> View:
    """Describe an image at its corners."""
    descriptors = describe_upright(gray, pixels)
    return View(gray, pixels, descriptors, describe_image(descriptors, _words()))


def describe_keyframe(keyframe: Keyframe) -> View:
    """Describe a keyframe's observations, once."""
    if keyframe.descriptor is None:
        made = view_of(keyframe.gray, keyframe.pixels)
        keyframe.descriptors, keyframe.descriptor = made.descriptors, made.descriptor
    described = keyframe.descriptors.any(axis=1)
    return View(
        keyframe.gray, keyframe.pixels[described], keyframe.descriptors[described], keyframe.descriptor
    )


def most_alike(
    descriptor: np.ndarray, model: SlamMap, excluded: np.ndarray, count: int | None
) -> list[tuple[int, float]]:
    """(keyframe, cosine) of the keyframes most similar to an image, best first.

    Args:
        descriptor: global descriptor of the image.
        model: the map.
        excluded: (k,) mask of keyframes to skip.
        count: number of keyframes; None: all.
    """
    numbers = [k for k in np.flatnonzero(~excluded) if model.keyframes[k].descriptor is not None]
    if not numbers:
        return []
    cosine = np.stack([model.keyframes[k].descriptor for k in numbers]) @ descriptor  # type: ignore[misc]
    return [(int(numbers[n]), float(cosine[n])) for n in np.argsort(-cosine, kind="stable")[:count]]


def recognize(
    view: View,
    model: SlamMap,
    number: int,
    camera: Camera | CameraRig,
    config: OdometryConfig,
    unwanted: np.ndarray | None = None,
) -> Recognition:
    """Match an image to a keyframe and its neighbors.

    Descriptors are matched, P3P in RANSAC estimates a pose, and all points in sight at this pose are searched.

    Args:
        view: the image.
        model: the map.
        number: index of the keyframe.
        camera: of both images.
        config: thresholds.
        unwanted: rows of points to ignore, namely those around the image's own keyframe.
    """
    points, descriptors = _points_around(model, number, unwanted)
    matches = match_descriptors(view.descriptors, descriptors, MatchConfig(max_ratio=0.85))
    none = Rigid3.identity(), np.zeros((0, 2)), np.zeros(0, np.int64)
    if len(matches) < MIN_SAMPLE:
        return Recognition(
            number, len(matches), f"{len(matches)} points match, {MIN_SAMPLE} are needed", *none
        )
    pixels, rows = view.pixels[matches[:, 0]], points[matches[:, 1]]
    limit = config.max_error_px
    ransac = RansacConfig(max_error_px=limit, min_inliers=MIN_SAMPLE, seed=config.seed)
    sought = search_pose(model.xyz[rows], pixels, camera, ransac)
    if sought is None:
        return Recognition(number, len(matches), f"no pose agrees with {MIN_SAMPLE} matches", *none)
    refined = refine_pose(model.xyz[rows], pixels, camera, sought)
    agrees = refined.error_sq <= limit**2
    if agrees.sum() < max(MIN_SAMPLE, MIN_FRACTION * len(matches)):
        words = f"the best pose agrees with only {int(agrees.sum())} of {len(matches)} matches"
        return Recognition(number, len(matches), words, *none)
    return _grown(
        view,
        model,
        Recognition(number, len(matches), "", refined.cam_from_world, pixels, points),
        camera,
        config,
    )


def _grown(
    view: View, model: SlamMap, found: Recognition, camera: Camera | CameraRig, config: OdometryConfig
) -> Recognition:
    """Search all points in sight at a pose by their patches, and refine the pose with them."""
    position, points = found.cam_from_world, found.points
    pixels, inside = project_in_sight(camera, position.apply(model.xyz[points]), RIM_PX)
    points, pixels = points[inside], pixels[inside]
    # Each round starts from the projections of a better pose.
    agrees = np.zeros(len(points), bool)
    for _ in range(ROUNDS):
        aligned, is_same, is_stale = align_to_reference_patch(
            model, camera, view.gray, position, points, pixels
        )
        is_alike = is_same & ~is_stale
        if is_alike.sum() < MIN_AGREEING:
            words = f"only {int(is_alike.sum())} of {len(points)} patches match at this pose, {MIN_AGREEING} are needed"
            return replace(found, reason=words, pixels=aligned[is_alike], points=points[is_alike])
        refined = refine_pose(model.xyz[points[is_alike]], aligned[is_alike], camera, position)
        position = refined.cam_from_world
        agrees = is_alike.copy()
        agrees[is_alike] = refined.error_sq <= config.max_error_px**2
        pixels = project_as(camera, position.apply(model.xyz[points]), pixels)
    reason = ""
    if agrees.sum() < MIN_AGREEING:
        reason = f"only {int(agrees.sum())} points with matching patches agree, {MIN_AGREEING} are needed"
    return replace(
        found, reason=reason, cam_from_world=position, pixels=aligned[agrees], points=points[agrees]
    )


def is_same_position(
    cam_from_world: Rigid3, found: Recognition, model: SlamMap, camera: Camera | CameraRig
) -> bool:
    """Whether another pose projects the inliers to the same pixels."""
    points = model.xyz[found.points]
    one = project_as(camera, cam_from_world.apply(points), found.pixels)
    other = project_as(camera, found.cam_from_world.apply(points), found.pixels)
    off = np.linalg.norm(one - other, axis=1)
    return float(np.median(np.where(np.isfinite(off), off, np.inf))) <= SAME_POSITION_PX


def rival_of(
    best: Recognition, others: list[Recognition], model: SlamMap, camera: Camera | CameraRig
) -> Recognition | None:
    """A different pose with nearly as many inliers, which makes the best one ambiguous; None if there is none."""
    for other in others:
        is_near = len(other.points) > RIVAL_FRACTION * len(best.points)
        if is_near and not is_same_position(other.cam_from_world, best, model, camera):
            return other
    return None


def _points_around(model: SlamMap, number: int, unwanted: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """(points, descriptors) of a keyframe, and those of its neighbors that it does not observe itself."""
    shared = model.num_shared([number])
    shared[number] = np.iinfo(np.int64).max
    taken = np.zeros(model.num_points, bool)
    taken[~np.isfinite(model.xyz[:, 0])] = True
    if unwanted is not None:
        taken[unwanted] = True
    points, descriptors = [np.zeros(0, np.int64)], [np.zeros((0, 128), np.uint8)]
    for k in np.argsort(-shared, kind="stable")[: 1 + NEIGHBORS]:
        own = model.keyframes[int(k)]
        fresh = np.flatnonzero(~taken[own.point] & own.descriptors.any(axis=1))
        if shared[k] == 0:
            continue
        points.append(own.point[fresh])
        descriptors.append(own.descriptors[fresh])
        taken[points[-1]] = True
    return np.concatenate(points), np.concatenate(descriptors)
