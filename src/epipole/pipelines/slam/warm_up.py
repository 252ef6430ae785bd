"""Compile, or load from disk, every kernel of SLAM before the first frame: a small camera moves through a synthetic room."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from typing import Protocol

import cv2
import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.inertial import ImuLog, ImuNoise, MountedImu, align_path_to_imu, imu_factors
from epipole.pipelines.slam.frames import Frame, SlamCamera, TrackedFrame
from epipole.scene import CameraRig

WIDTH_PX = 320
NUM_FRAMES, NUM_BLACK, NUM_SEEN_AGAIN = 14, 2, 4
MOTION, MOST_UNITS, ROTATION_RAD = 0.05, 0.25, 0.02
"""Motion between two frames, as a fraction of the image width at the wall ahead, at most so far; and rotation. Most frames become keyframes."""
ROOM = np.array([5.0, 3.0, 5.0])
"""Half the size of the room, whose x axis points right, y down and z forward."""
TEXELS = 30.0
"""Texels of the walls in a unit."""
DISPARITY_PX, DEPTH_UNIT_M, RIG_UNITS = 20.0, 0.5, 3.0
"""The unit of the room: such that the wall ahead has this disparity, or in meters, or relative to the size of a rig."""
SWAY_S = 2.0


_warm: set[tuple[bool, ...]] = set()
"""Kinds of cameras whose kernels this process has loaded."""


class Tracker(Protocol):
    """What is used of `Slam`."""

    def track(self, frame: Frame) -> TrackedFrame:
        """Estimate the pose of the next frame."""

    def finish(self) -> None:
        """Adjust the whole map."""


def warm_up(camera: SlamCamera, make: Callable[[SlamCamera], Tracker]) -> None:
    """Track a camera of this kind through the room, cover it, and let it be relocalized; once per process.

    Args:
        camera: camera, stereo pair, depth camera or rig.
        make: makes a `Slam` for a camera.
    """
    parts = camera.rig, camera.baseline, camera.depth
    kind = (*(part is not None for part in parts), camera.shutter.is_rolling)
    if kind in _warm:
        return
    small = small_camera(camera)
    system = make(small)
    for frame in warm_up_frames(small):
        system.track(frame)
    system.finish()
    _warm.add(kind)


@cache
def warm_up_imu() -> None:
    """Align a camera that sways for two seconds to its IMU, and take the derivatives of the factors; once per process."""
    times, rate = np.linspace(0.0, SWAY_S, 401), np.array([5.0, 7.0, 9.0])
    sway = 0.1 * np.sin(times[:, None] * rate)
    log = ImuLog(times, np.zeros((len(times), 3)), -(rate**2) * sway + [0.0, 0.0, 9.81])
    imu = MountedImu(log, Rigid3.identity(), ImuNoise())
    path = Rigid3(np.tile(np.eye(3), (21, 1, 1)), sway[::20])
    aligned = align_path_to_imu(times[::20], path, imu, 1e-3, 1e-3, is_metric=True)
    factors = imu_factors(np.arange(len(path)), times[::20], path, imu, aligned, is_metric=True)
    factors.linearized(path.inverse())


def small_camera(camera: SlamCamera) -> SlamCamera:
    """The same kind of camera with small images, for which the same kernels are compiled."""
    if (rig := camera.rig) is not None:
        return SlamCamera.of_cameras(CameraRig(tuple(map(_scaled, rig.cameras)), rig.cam_from_rig))
    depth = None if camera.depth is None else replace(camera.depth, camera=_scaled(camera.depth.camera))
    return replace(camera, camera=_scaled(camera.camera), depth=depth)


def _scaled(camera: Camera) -> Camera:
    factor = min(1.0, WIDTH_PX / camera.width)
    return camera.scaled_to(round(factor * camera.width), round(factor * camera.height))


def warm_up_frames(camera: SlamCamera) -> Iterator[Frame]:
    """A motion to the right with a rotation, black images, and the first images again.

    Args:
        camera: camera, stereo pair, depth camera or rig.
    """
    unit, room = _unit_of(camera), _Room()
    cameras = (camera.camera,) if camera.rig is None else camera.rig.cameras
    step = unit * min(MOST_UNITS, *(MOTION * ROOM[2] * one.width / one.focal_px for one in cameras))
    order = [*range(NUM_FRAMES), *[-1] * NUM_BLACK, *range(NUM_SEEN_AGAIN)]
    for number, k in enumerate(order):
        world_from_body = Rigid3.exp([0, 0, 0, 0, 0.5 + ROTATION_RAD * k, 0])
        position = step * k * np.array([1.0, 0.2 * np.sin(k), 0.2])
        pose = Rigid3(world_from_body.rotation, position).inverse()
        frame = _frame(room, camera, pose, unit, 0.1 * number)
        yield frame if k >= 0 else replace(frame, gray=np.zeros_like(frame.gray))


def _frame(room: _Room, camera: SlamCamera, body_from_world: Rigid3, unit: float, time_s: float) -> Frame:
    if (rig := camera.rig) is not None:
        poses = rig.cam_from_rig @ body_from_world
        images = [room.seen_by(one, poses[k], unit)[0] for k, one in enumerate(rig.cameras)]
        return Frame.from_rig(time_s, images, rig)
    frame = Frame(time_s, room.seen_by(camera.camera, body_from_world, unit)[0])
    if camera.baseline is not None:
        right = Rigid3(np.eye(3), np.array([-camera.baseline, 0.0, 0.0])) @ body_from_world
        return replace(frame, right_gray=room.seen_by(camera.camera, right, unit)[0])
    if camera.depth is not None:
        pose = camera.depth.depth_from_color @ body_from_world
        depth = room.seen_by(camera.depth.camera, pose, unit)[1] / camera.depth.scale
        return replace(frame, depth=depth.astype(np.float32))
    return frame


def _unit_of(camera: SlamCamera) -> float:
    """Unit of the room in which the camera measures depth well."""
    if camera.rig is not None:
        centers = camera.rig.cam_from_rig.centers()
        return RIG_UNITS * float(np.linalg.norm(centers - centers[0], axis=1).max())
    if camera.baseline is not None:
        return camera.camera.focal_px * camera.baseline / DISPARITY_PX / ROOM[2]
    return DEPTH_UNIT_M


class _Room:
    """The inside of a box with random textures."""

    def __init__(self) -> None:
        noise = np.random.default_rng(0).normal(0.0, 1.0, (1024, 1024))
        smooth = 1.5 * cv2.GaussianBlur(noise, (0, 0), 1.5) + 4.0 * cv2.GaussianBlur(noise, (0, 0), 4.0)
        self._texture = np.clip(128.0 + 40.0 * smooth / smooth.std(), 0, 255).astype(np.uint8)

    def seen_by(self, camera: Camera, cam_from_world: Rigid3, unit: float) -> tuple[np.ndarray, np.ndarray]:
        """(h, w) image, and depth along the optical axis; black and zero where the camera has no ray."""
        y, x = np.mgrid[: camera.height, : camera.width]
        rays = camera.unproject(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
        direction, center = rays @ cam_from_world.rotation, cam_from_world.centers() / unit
        with np.errstate(all="ignore"):  # where there is no ray
            along = (np.sign(direction) * ROOM - center) / direction
            axis = np.argmin(along, axis=1)
            distance = np.take_along_axis(along, axis[:, None], axis=1)
        is_seen = np.isfinite(distance[:, 0]) & np.isfinite(rays).all(axis=1)
        hit = center + distance[is_seen] * direction[is_seen]
        wall = axis[is_seen]
        side = np.take_along_axis(hit, (wall[:, None] + [[1, 2]]) % 3, axis=1)
        # Each wall has another part of the texture.
        part = 170 * (2 * wall + (np.take_along_axis(hit, wall[:, None], axis=1)[:, 0] > 0))
        column, row = (np.rint(TEXELS * side).astype(np.int64) + part[:, None]).T % 1024
        gray, depth = np.zeros(len(rays), np.uint8), np.zeros(len(rays))
        gray[is_seen] = self._texture[row, column]
        depth[is_seen] = distance[is_seen, 0] * rays[is_seen, 2] * unit
        return gray.reshape(camera.height, camera.width), depth.reshape(camera.height, camera.width)
