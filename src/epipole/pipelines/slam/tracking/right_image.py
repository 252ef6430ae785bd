"""Tracking in the right image of a stereo pair whose left image shows nothing, e.g. because the camera is covered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from epipole.cameras import Camera
from epipole.features.flow import track_points
from epipole.geometry import Rigid3
from epipole.mapping import RefinedPose
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.frames import Frame, SlamCamera
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.tracking.points import Tracks, locate


def pose_from_right_image(
    model: SlamMap,
    sensor: SlamCamera,
    frames: tuple[Frame, Frame],
    position: Rigid3,
    points: np.ndarray,
    config: OdometryConfig,
) -> tuple[RefinedPose, Tracks] | None:
    """Pose of the left camera, and the inliers at their projections into its image; None if there are too few.

    Args:
        model: the map.
        sensor: the pair.
        frames: the previous and the present frame.
        position: cam_from_world of the previous frame.
        points: (n,) rows of the tracked points.
        config: thresholds.
    """
    before, frame = frames
    if before.right_gray is None or frame.right_gray is None or sensor.baseline is None:
        return None
    right = _right_camera(sensor.camera, model.right_shift_px)
    right_from_left = Rigid3(np.eye(3), np.array([-sensor.baseline, 0.0, 0.0]))
    points = points[model.is_triangulated(points)]
    was = right.project((right_from_left @ position).apply(model.xyz[points]))
    inside = ((was >= 0) & (was < [right.width, right.height])).all(axis=1)
    points, was = points[inside], was[inside]
    pixels, found = track_points(before.right_gray, frame.right_gray, was, was, config)
    points, pixels = points[found], pixels[found]
    located = locate(model.xyz[points], pixels, right, right_from_left @ position, None, config)
    if located is None:
        return None
    refined, agrees = located
    here = right_from_left.inverse() @ refined.cam_from_world
    # exp(xi) right_from_left = right_from_left exp(Ad xi): transform the information accordingly.
    adjoint = right_from_left.adjoint()
    refined = replace(refined, cam_from_world=here, information=adjoint.T @ refined.information @ adjoint)
    seen = sensor.camera.project(here.apply(model.xyz[points[agrees]]))
    return refined, Tracks(seen, points[agrees], seen.copy())


def _right_camera(left: Camera, shift_px: float) -> Camera:
    params = left.params.copy()
    params[left.model.principal_point_indices[0]] += shift_px
    return Camera(left.model, left.width, left.height, params)
