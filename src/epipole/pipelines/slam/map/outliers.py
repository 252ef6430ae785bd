"""Outliers of the map: observations that contradict the adjusted poses and points."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from epipole.cameras import Camera
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.tracking.projection import project_as
from epipole.scene import CameraRig


def remove_outliers(
    model: SlamMap, camera: Camera | CameraRig, keyframes: Iterable[int], max_error_px: float
) -> None:
    """Remove the keyframes' observations with a larger reprojection error or with the point behind the camera."""
    for k in keyframes:
        own = model.keyframes[k]
        localized = model.is_triangulated(own.point)
        straight, xyz = own.straight_px[localized], model.xyz[own.point[localized]]
        at = project_as(camera, own.cam_from_world.apply(xyz), straight)
        off = np.zeros(len(own.point), bool)
        off[localized] = ~(np.linalg.norm(at - straight, axis=1) <= max_error_px)
        if off.any():
            own.keep(~off)
