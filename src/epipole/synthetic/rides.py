"""Rides: SLAM sequences with exact ground truth, rendered frame by frame, in meters, world z up."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.interpolate import PchipInterpolator

from epipole._checks import check_count, checked
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.synthetic.ride import Ride, Shutter
from epipole.synthetic.ride_scenes import (
    corridor_with_a_bend,
    furnished_room,
    furnished_room_things,
    room_of_four_objects,
)
from epipole.synthetic.scene import Box, SyntheticScene, Texture

FOCAL_FRACTION = 0.7
"""Focal length over image width: a horizontal field of view of 71 degrees."""
BASELINE_M, RATE_HZ, EYE_M = 0.12, 30.0, 1.35
Size = tuple[int, int]
_CORRIDOR_TRAJECTORY = (
    # frame, x, y, yaw in degrees
    (0, 0.0, 0.0, 0.0),
    (50, 2.5, 0.0, 0.0),
    (105, 5.25, 0.0, 0.0),
    (145, 5.5, 0.3, 90.0),
    (235, 5.5, 4.8, 90.0),
    (295, 5.3, 4.8, 270.0),
    (385, 5.5, 0.3, 270.0),
    (425, 5.25, 0.0, 180.0),
    (530, 0.0, 0.0, 180.0),
    (590, 0.0, 0.1, 0.0),
    (620, 1.5, 0.0, 0.0),
)
_HAND_HZ = (
    ((0.7, 0.3), (1.7, 1.1), (2.9, 2.0)),
    ((0.9, 2.2), (1.9, 0.4), (3.1, 1.3)),
    ((1.1, 1.7), (2.3, 0.9), (3.7, 2.6)),
)
"""Frequencies and phases of hand shake: forward, sideways, up."""


@checked
def loop_room(num_frames: int = 400, size: Size = (640, 480)) -> Ride:
    """Once around a furnished room of 6 x 5 m, on a circle of radius 1 m looking outward, one degree per frame.

    From frame 360 on the camera revisits the start.

    Args:
        num_frames: one degree each.
        size: width and height of the images.

    Raises:
        ConfigError: num_frames is less than 1, or the image is too small.
    """

    def path(times: np.ndarray) -> Rigid3:
        angle = np.deg2rad(1.0) * RATE_HZ * times
        center = np.stack([np.cos(angle), np.sin(angle), EYE_M + 0.03 * np.sin(5.1 * times)], axis=1)
        pitch, roll = np.deg2rad(3.0) * np.sin(2.3 * times) - 0.05, np.deg2rad(1.5) * np.sin(1.7 * times)
        return facing(center, angle + 0.04 * np.sin(1.9 * times), pitch, roll)

    return _ride("loop_room", num_frames, size, path, furnished_room())


@checked
def rotate_only(num_frames: int = 200, size: Size = (640, 480)) -> Ride:
    """Pure rotation of 360 degrees about the left camera's center in the same room (1.8 degrees per frame by default).

    Args:
        num_frames: of the full rotation.
        size: width and height of the images.

    Raises:
        ConfigError: num_frames is less than 1, or the image is too small.
    """

    def path(times: np.ndarray) -> Rigid3:
        angle = 2.0 * np.pi * RATE_HZ * times / num_frames
        center = np.broadcast_to([0.2, -0.1, EYE_M], (len(times), 3))
        return facing(center, angle, np.full(len(times), -0.05), np.zeros(len(times)))

    return _ride("rotate_only", num_frames, size, path, furnished_room())


@checked
def tiled_room(num_frames: int = 400, size: Size = (640, 480)) -> Ride:
    """Once around a square room with four identical sides, on a circle of radius 0.7 m, one degree per frame.

    Images repeat every 90 degrees, but the camera returns only after 360: a loop between frames 60 to 300 apart is false.

    Args:
        num_frames: one degree each.
        size: width and height of the images.

    Raises:
        ConfigError: num_frames is less than 1, or the image is too small.
    """

    def path(times: np.ndarray) -> Rigid3:
        angle = np.deg2rad(1.0) * RATE_HZ * times
        height = EYE_M + 0.03 * np.sin(4.3 * times)
        center = np.stack([0.7 * np.cos(angle), 0.7 * np.sin(angle), height], axis=1)
        return facing(center, angle, np.deg2rad(2.0) * np.sin(2.1 * times) - 0.05, np.zeros(len(times)))

    return _ride("tiled_room", num_frames, size, path, room_of_four_objects())


@checked
def corridor(num_frames: int = 620, size: Size = (640, 480)) -> Ride:
    """Along a corridor with a bend, to its end and back to the start, 5 cm per frame.

    The wall ahead at the bend is white: frames 97 to 118 show nothing else. The way back has texture throughout, and from frame 575 on
    the camera revisits the start.

    Args:
        num_frames: the trajectory ends after 620.
        size: width and height of the images.

    Raises:
        ConfigError: num_frames is less than 1, or the image is too small.
    """
    frame, x, y, yaw_deg = np.array(_CORRIDOR_TRAJECTORY).T
    offset = PchipInterpolator(frame / RATE_HZ, np.stack([x, y, np.deg2rad(yaw_deg)], axis=1))

    def path(times: np.ndarray) -> Rigid3:
        there = offset(np.clip(times, 0.0, frame[-1] / RATE_HZ))
        height = EYE_M + 0.02 * np.sin(9.0 * times)
        center = np.stack([there[:, 0], there[:, 1], height], axis=1)
        return facing(center, there[:, 2], np.deg2rad(1.0) * np.sin(2.1 * times), np.zeros(len(times)))

    return _ride("corridor", num_frames, size, path, corridor_with_a_bend())


@checked
def walking_box(num_frames: int = 240, size: Size = (640, 480)) -> Ride:
    """A box the size of a person crosses the image of a camera that moves, stops and moves on in the furnished room.

    It is in sight from about frame 70 to 180 and covers up to a third of the image; the camera is at rest from 90 to 150.

    Args:
        num_frames: from the start.
        size: width and height of the images.

    Raises:
        ConfigError: num_frames is less than 1, or the image is too small.
    """
    offset = PchipInterpolator(np.array([0.0, 90.0, 150.0, 240.0]) / RATE_HZ, [-0.8, 0.1, 0.1, 0.9])
    room = furnished_room_things()

    def path(times: np.ndarray) -> Rigid3:
        aside = offset(np.clip(times, 0.0, 240.0 / RATE_HZ))
        # On a straight trajectory the alignment with an estimate would be ambiguous.
        ahead, height = -1.7 + 0.2 * np.cos(2.0 * aside), EYE_M + 0.06 * np.sin(3.0 * aside)
        center = np.stack([ahead, aside, height], axis=1)
        return facing(center, 0.08 * aside, np.full(len(times), -0.03), np.zeros(len(times)))

    def scene(time: float) -> SyntheticScene:
        walker = Box(
            center=(0.6, 0.96 * (time - 120.0 / RATE_HZ), 0.95), half_size=(0.3, 0.5, 0.95), seed=61,
            color=(0.42, 0.40, 0.56), texture=Texture.TILED, tile_m=4.0,
        )  # fmt: skip
        return SyntheticScene.of([*room, walker])

    return _ride("walking_box", num_frames, size, path, scene)


@checked
def shuttered(num_frames: int = 240, size: Size = (640, 480), readout_s: float = 0.03) -> Ride:
    """A hand-held camera with a rolling shutter moves 2 m sideways through the furnished room.

    Args:
        num_frames: from the start.
        size: width and height of the images.
        readout_s: from the first row to the one after the last; 0 is a global shutter.

    Raises:
        ConfigError: num_frames is less than 1, the image is too small, or readout_s is negative.
    """

    def path(times: np.ndarray) -> Rigid3:
        rotation = 2.0 * np.pi * times
        shake = [sum(np.sin(f * rotation + p) for f, p in waves) for waves in _HAND_HZ]
        aside = -1.0 + 2.0 * times / (240.0 / RATE_HZ)
        center = np.stack([-1.2 + 0.01 * shake[0], aside + 0.01 * shake[1], EYE_M + 0.015 * shake[2]], axis=1)
        degree = np.deg2rad(1.0)
        return facing(
            center, 1.2 * degree * shake[1], degree * shake[2] - 0.04, 0.8 * degree * (shake[0] + shake[2])
        )

    ride = _ride("shuttered" if readout_s > 0 else "unshuttered", num_frames, size, path, furnished_room())
    return replace(ride, shutter=Shutter(readout_s=readout_s))


def facing(center: np.ndarray, yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> Rigid3:
    """world_from_camera of cameras at centers (k, 3): yaw about z from +x, pitch upwards, roll clockwise, (k,) rad each."""
    zero = np.zeros(len(yaw))
    forward = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=1)
    level = np.stack([np.sin(yaw), -np.cos(yaw), zero], axis=1)
    down = np.cross(forward, level)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    rotation = np.stack([c * level + s * down, c * down - s * level, forward], axis=2)
    return Rigid3(rotation, np.array(center, np.float64))


def _ride(
    name: str,
    num_frames: int,
    size: Size,
    path: Callable[[np.ndarray], Rigid3],
    scene: SyntheticScene | Callable[[float], SyntheticScene],
) -> Ride:
    check_count(num_frames, "num_frames")
    width, height = size
    if num_frames < 1 or min(size) < 16:
        raise ConfigError(
            f"a ride needs at least 1 frame of at least 16 x 16 pixels, got {num_frames} of {width} x {height}"
        )
    focal = FOCAL_FRACTION * width
    camera = Camera(
        CameraModel.PINHOLE, width, height, np.array([focal, focal, (width - 1) / 2, (height - 1) / 2])
    )
    scene_at = (lambda _: scene) if isinstance(scene, SyntheticScene) else scene
    return Ride(name, camera, BASELINE_M, np.arange(num_frames) / RATE_HZ, path, scene_at)
