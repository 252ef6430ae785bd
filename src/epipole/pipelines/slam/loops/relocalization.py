"""Where a lost camera is: the places of the map that look most like its image are compared with it."""

from __future__ import annotations

import numpy as np

from epipole.cameras import Camera
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.loops.recognition import Recognition, most_alike, recognize, rival_of, view_of
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.tracking.corners import new_corners

LATEST, ALIKE = 2, 4
"""Keyframes that are compared with each lost frame: the last ones, and those that look most alike."""


def relocalize(
    grey: np.ndarray, model: SlamMap, camera: Camera, config: OdometryConfig
) -> Recognition | None:
    """The place of an image in a map, by the keyframe with most points in agreement.

    None if none has enough, or if two places look like it.
    """
    corners = new_corners(grey, np.zeros((0, 2)), config)
    if not len(corners):
        return None
    view, count = view_of(grey, corners), len(model.keyframes)
    latest = list(range(max(0, count - LATEST), count))
    alike = [k for k, _ in most_alike(view.descriptor, model, np.zeros(count, bool), ALIKE)]
    found = [recognize(view, model, k, camera, config) for k in dict.fromkeys([*alike, *latest])]
    good = [f for f in found if not f.reason]
    if not good:
        return None
    best = max(good, key=lambda f: len(f.points))
    return best if rival_of(best, good, model, camera) is None else None
