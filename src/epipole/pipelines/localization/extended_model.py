"""A model with the images that were localized in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.pipelines.localization.localized_image import LocalizedImage
from epipole.scene import Cameras, Frames, Images, Reconstruction, Rigs, Tracks

PREFIX = "localized/"
"""Before names that the model's images already have."""


def names_in_model(model: Reconstruction, names: Sequence[str]) -> tuple[str, ...]:
    """Names of added images; those that the model already has get a prefix."""
    taken, out = set(model.images.name), []
    for name in names:
        while name in taken:
            name = f"{PREFIX}{name}"
        taken.add(name)
        out.append(name)
    return tuple(out)


def with_localized(
    model: Reconstruction,
    names: Sequence[str],
    images: Sequence[LocalizedImage],
    timestamps_s: np.ndarray,
) -> Reconstruction:
    """Add localized images with their cameras and observations; nothing else changes.

    Args:
        model: the model.
        names: names of the images in the model (`names_in_model`).
        images: their poses; all are localized.
        timestamps_s: their times, NaN where unknown.
    """
    if not images:
        return model
    num, count = len(model.images), len(images)
    cameras, rigs, sensor_of = _with_cameras(model, images)
    rig_of = rigs.rig_of_sensor()[sensor_of]
    poses = Rigid3(
        np.stack([image.cam_from_world.rotation for image in images]),
        np.stack([image.cam_from_world.translation for image in images]),
    )
    frames = Frames(
        np.append(model.frames.rig, rig_of).astype(np.int32),
        Rigid3(
            np.concatenate([model.frames.rig_from_world.rotation, poses.rotation]),
            np.concatenate([model.frames.rig_from_world.translation, poses.translation]),
        ),
        np.append(model.frames.timestamp_s, timestamps_s),
    )
    sizes = [len(image.pixels) for image in images]
    offsets = model.images.keypoint_offsets
    all_images = Images(
        (*model.images.name, *names),
        np.append(model.images.frame, len(model.frames) + np.arange(count)).astype(np.int32),
        np.append(model.images.sensor, sensor_of).astype(np.int32),
        np.concatenate([offsets, offsets[-1] + np.cumsum(sizes)]).astype(np.int64),
        np.concatenate([model.images.keypoints_px, *(image.pixels for image in images)]),
    )
    point = np.concatenate([model.tracks.point_of_observation(), *(image.point for image in images)])
    image_of = np.append(model.tracks.image, np.repeat(num + np.arange(count), sizes))
    keypoint = np.concatenate([model.tracks.keypoint, *(np.arange(size) for size in sizes)])
    order = np.argsort(point, kind="stable")
    seen = np.bincount(point, minlength=len(model.points))
    tracks = Tracks(
        np.concatenate([[0], np.cumsum(seen)]).astype(np.int64),
        image_of[order].astype(np.int32),
        keypoint[order].astype(np.int32),
    )
    return replace(model, cameras=cameras, rigs=rigs, frames=frames, images=all_images, tracks=tracks)


def _with_cameras(
    model: Reconstruction, images: Sequence[LocalizedImage]
) -> tuple[Cameras, Rigs, np.ndarray]:
    """Cameras and rigs with those of the images, and the sensor of each image.

    Images of a camera of the model share it, unless it is a part of a rig of several cameras.
    """
    all_cameras = [model.cameras[c] for c in range(len(model.cameras))]
    rigs, is_single = model.rigs, np.diff(model.rigs.sensor_offsets) == 1
    sensor_of_key = {
        _key(all_cameras[int(rigs.sensor_camera[s])]): int(s)
        for s in np.flatnonzero(is_single[rigs.rig_of_sensor()])[::-1]
    }
    sensors = []
    for image in images:
        key = _key(image.camera)
        if key not in sensor_of_key:
            sensor_of_key[key] = len(rigs.sensor_camera) + len(all_cameras) - len(model.cameras)
            all_cameras.append(image.camera)
        sensors.append(sensor_of_key[key])
    more = len(all_cameras) - len(model.cameras)
    flags = [
        np.append(flag, np.ones(more, bool))
        for flag in (model.cameras.is_focal_trusted, model.cameras.is_constant)
    ]
    cameras = Cameras.from_list(all_cameras, flags[0].tolist(), flags[1].tolist())
    return cameras, _with_single_cameras(rigs, len(model.cameras), len(cameras)), np.array(sensors)


def _key(camera: Camera) -> tuple:
    return camera.model, camera.width, camera.height, camera.params.tobytes()


def _with_single_cameras(rigs: Rigs, num_before: int, num_after: int) -> Rigs:
    """One rig more for each further camera."""
    more = np.arange(num_before, num_after, dtype=np.int32)
    ends = rigs.sensor_offsets[-1] + 1 + np.arange(len(more))
    identity = Rigid3.identity(len(more))
    return Rigs(
        np.append(rigs.sensor_offsets, ends).astype(np.int32),
        np.append(rigs.sensor_camera, more).astype(np.int32),
        Rigid3(
            np.concatenate([rigs.cam_from_rig.rotation, identity.rotation]),
            np.concatenate([rigs.cam_from_rig.translation, identity.translation]),
        ),
    )
