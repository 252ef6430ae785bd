"""Which place of a map a picture shows: pictures that look alike, points that match, and a pose with which they agree."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from epipole.cameras import Camera
from epipole.config import MatchConfig, RansacConfig
from epipole.features import describe_image, describe_upright, match_descriptors
from epipole.geometry import Rigid3
from epipole.mapping import refine_pose
from epipole.pipelines.slam.anchoring import hold
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.revisiting import find_again
from epipole.pipelines.slam.slam_map import Keyframe, SlamMap
from epipole.robust import estimate_absolute_pose

WORDS = Path(__file__).parent / "assets" / "words.npy"
NEIGHBOURS = 3
"""Further keyframes whose points are compared together with those of one that looks alike."""
MIN_SAMPLE, MIN_SHARE = 15, 0.4
"""Fewest matches, and the share of them, that a pose must agree with. Patches that look alike by chance agree less."""
MIN_AGREEING = 30
"""... and fewest points when those that only the pose lets find are counted, too."""


class View(NamedTuple):
    """A picture to be recognised."""

    grey: np.ndarray
    pixels: np.ndarray  # (n, 2)
    descriptors: np.ndarray  # (n, 128)
    look: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Recognition:
    """What came of comparing a picture with a place of the map."""

    keyframe: int
    """The keyframe that looks alike."""
    num_matches: int
    reason: str
    """Why it is not the same place; empty if it is."""
    cam_from_world: Rigid3
    pixels: np.ndarray
    """(n, 2) of points in agreement."""
    points: np.ndarray
    """(n,) rows of the map."""


@cache
def _words() -> np.ndarray:
    return np.load(WORDS).astype(np.float32)


def view_of(grey: np.ndarray, pixels: np.ndarray) -> View:
    """A picture described at its corners."""
    descriptors = describe_upright(grey, pixels)
    return View(grey, pixels, descriptors, describe_image(descriptors, _words()))


def describe_keyframe(keyframe: Keyframe) -> View:
    """Describe a keyframe's observations, once."""
    if keyframe.look is None:
        made = view_of(keyframe.grey, keyframe.pixels)
        keyframe.descriptors, keyframe.look = made.descriptors, made.look
    described = keyframe.descriptors.any(axis=1)
    return View(keyframe.grey, keyframe.pixels[described], keyframe.descriptors[described], keyframe.look)


def most_alike(look: np.ndarray, model: SlamMap, excluded: np.ndarray, count: int) -> list[tuple[int, float]]:
    """(keyframe, cosine) of the keyframes that look most like a picture, best first.

    Args:
        look: of the picture.
        model: the map.
        excluded: (k,) keyframes not to be considered.
        count: how many.
    """
    numbers = [k for k in np.flatnonzero(~excluded) if model.keyframes[k].look is not None]
    if not numbers:
        return []
    cosine = np.stack([model.keyframes[k].look for k in numbers]) @ look  # type: ignore[misc]
    return [(int(numbers[n]), float(cosine[n])) for n in np.argsort(-cosine, kind="stable")[:count]]


def recognize(
    view: View,
    model: SlamMap,
    number: int,
    camera: Camera,
    config: SlamConfig,
    unwanted: np.ndarray | None = None,
) -> Recognition:
    """Compare a picture with a keyframe and its neighbours.

    Descriptors are matched, P3P in RANSAC finds a pose, and at this pose all points that should be in sight are looked for.

    Args:
        view: the picture.
        model: the map.
        number: of the keyframe.
        camera: of both.
        config: thresholds.
        unwanted: rows of points that are not to be used: those of the picture's own surroundings.
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
    sought = estimate_absolute_pose(model.xyz[rows], pixels, camera, ransac)
    if not sought.success:
        return Recognition(number, len(matches), f"no pose agrees with {MIN_SAMPLE} matches", *none)
    refined = refine_pose(model.xyz[rows], pixels, camera, sought.model)
    agrees = refined.error_sq <= limit**2
    if agrees.sum() < max(MIN_SAMPLE, MIN_SHARE * len(matches)):
        words = f"a pose agrees with {int(agrees.sum())} of {len(matches)} matches only"
        return Recognition(number, len(matches), words, *none)
    return _grown(view, model, number, camera, config, unwanted, refined.cam_from_world, len(matches))


def _grown(
    view: View,
    model: SlamMap,
    number: int,
    camera: Camera,
    config: SlamConfig,
    unwanted: np.ndarray | None,
    place: Rigid3,
    num_matches: int,
) -> Recognition:
    """All points in sight at a pose, and the pose that agrees with them."""
    followed = np.zeros(0, np.int64) if unwanted is None else unwanted
    pixels, points = find_again(model, camera, view.grey, place, followed, config)
    pixels, is_same, is_stale = hold(model, camera, view.grey, place, points, pixels)
    pixels, points = pixels[is_same & ~is_stale], points[is_same & ~is_stale]
    words, agrees = (
        f"{len(points)} points look the same there, {MIN_AGREEING} are needed",
        np.zeros(len(points), bool),
    )
    if len(points) >= MIN_AGREEING:
        refined = refine_pose(model.xyz[points], pixels, camera, place)
        agrees = refined.error_sq <= config.max_error_px**2
        words = (
            f"{int(agrees.sum())} of {len(points)} points that look the same agree, {MIN_AGREEING} are needed"
        )
        place = refined.cam_from_world
    reason = words if agrees.sum() < MIN_AGREEING else ""
    return Recognition(number, num_matches, reason, place, pixels[agrees], points[agrees])


def _points_around(model: SlamMap, number: int, unwanted: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """(points, descriptors) of a keyframe, and those of its neighbours that it does not see itself."""
    shared = model.num_shared([number])
    shared[number] = np.iinfo(np.int64).max
    taken = np.zeros(model.num_points, bool)
    taken[~np.isfinite(model.xyz[:, 0])] = True
    if unwanted is not None:
        taken[unwanted] = True
    points, descriptors = [np.zeros(0, np.int64)], [np.zeros((0, 128), np.uint8)]
    for k in np.argsort(-shared, kind="stable")[: 1 + NEIGHBOURS]:
        own = model.keyframes[int(k)]
        fresh = np.flatnonzero(~taken[own.point] & own.descriptors.any(axis=1))
        if shared[k] == 0:
            continue
        points.append(own.point[fresh])
        descriptors.append(own.descriptors[fresh])
        taken[points[-1]] = True
    return np.concatenate(points), np.concatenate(descriptors)
