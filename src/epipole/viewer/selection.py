"""What the viewer shows and from where: pure functions of arrays."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.scene.extent import WIDEST_HALF_ANGLE_RAD

LoadImage = Callable[[str], UInt8[np.ndarray, "h w 3"] | None]
"""The RGB picture of an image name, or None where there is none."""

PICTURE_SIDE_PX = 320
"""Longer side of a picture that is shown."""


def visible_points(
    error_px: Float64[np.ndarray, " n"],
    track_length: Int64[np.ndarray, " n"],
    max_error_px: float,
    min_track_length: int,
) -> Bool[np.ndarray, " n"]:
    """Mask of points at most this wrong and seen at least this often; an unknown error (NaN) passes."""
    too_wrong = np.nan_to_num(error_px, nan=0.0) > max_error_px
    return ~too_wrong & (track_length >= min_track_length)


def vertical_fov_rad(camera: Camera) -> float:
    """The angle from the picture's top to its bottom, limited to what a drawn frustum can show."""
    return float(min(2.0 * np.arctan2(0.5 * camera.height, camera.K[1, 1]), 2.0 * WIDEST_HALF_ANGLE_RAD))


def glide(world_from_start: Rigid3, world_from_goal: Rigid3, num_steps: int) -> Rigid3:
    """Places from start (excluded) to goal (included) on a screw motion with a gentle start and end."""
    u = np.arange(1, num_steps + 1) / num_steps
    start_from_goal = world_from_start.inverse() @ world_from_goal
    return world_from_start @ Rigid3.exp((u * u * (3.0 - 2.0 * u))[:, None] * start_from_goal.log())
