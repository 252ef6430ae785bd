"""Search of a pose without a prediction: P3P in RANSAC, for a rig in one camera at a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from epipole.cameras import Camera
from epipole.config import RansacConfig
from epipole.geometry import Rigid3
from epipole.pipelines.slam.tracking.projection import project_as
from epipole.robust import estimate_absolute_pose
from epipole.scene import CameraRig

LEAST_OF_ONE = 6
"""Fewest inliers in the camera from which the pose of a rig is computed."""


def search_pose(
    points_in_world: np.ndarray, pixels: np.ndarray, camera: Camera | CameraRig, ransac: RansacConfig
) -> Rigid3 | None:
    """The pose with most inliers; None if there is none.

    A rig's pose comes from the points of one of its cameras; the inliers of all cameras decide which, and whether they are enough.
    """
    if not isinstance(camera, CameraRig):
        sought = estimate_absolute_pose(points_in_world, pixels, camera, ransac)
        return sought.model if sought.success else None
    needed = LEAST_OF_ONE if ransac.min_inliers is None else ransac.min_inliers
    which, best, most = camera.camera_of(pixels), None, needed - 1
    of_one = replace(ransac, min_inliers=min(LEAST_OF_ONE, needed))
    for k, one in enumerate(camera.cameras):
        rows = which == k
        local = pixels[rows] - [0.0, float(camera.tops[k])]
        sought = estimate_absolute_pose(points_in_world[rows], local, one, of_one)
        if not sought.success:
            continue
        found = camera.cam_from_rig[k].inverse() @ sought.model
        off = project_as(camera, found.apply(points_in_world), pixels) - pixels
        count = int((np.linalg.norm(off, axis=1) <= ransac.max_error_px).sum())
        if count > most:
            best, most = found, count
    return best
