"""Relocalization of a lost camera by the most similar keyframes."""

from __future__ import annotations

import numpy as np

from epipole.cameras import Camera
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.loops.recognition import Recognition, most_alike, recognize, rival_of, view_of
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.tracking.corners import new_corners

LATEST = 2
"""Newest keyframes to which each lost frame is matched."""
ALIKE = 4
"""Most similar keyframes to which each lost frame is matched."""


def relocalize(
    gray: np.ndarray, model: SlamMap, camera: Camera, config: OdometryConfig
) -> Recognition | None:
    """The pose of an image in a map, by the keyframe with most inliers; None if too few or ambiguous."""
    corners = new_corners(gray, np.zeros((0, 2)), config)
    if not len(corners):
        return None
    view, count = view_of(gray, corners), len(model.keyframes)
    latest = list(range(max(0, count - LATEST), count))
    alike = [k for k, _ in most_alike(view.descriptor, model, np.zeros(count, bool), ALIKE)]
    found = [recognize(view, model, k, camera, config) for k in dict.fromkeys([*alike, *latest])]
    good = [f for f in found if not f.reason]
    if not good:
        return None
    best = max(good, key=lambda f: len(f.points))
    return best if rival_of(best, good, model, camera) is None else None
