"""The rigs of an OpenSfM reconstruction: cam_from_rig in `rig_cameras`, rig_from_world in `rig_instances`.

The poses of the images are those products, too. In the file, any camera of a rig may differ from the frame of the rig;
here, the first one is that frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from epipole.errors import ConfigError
from epipole.geometry import Rigid3, Rotation3
from epipole.io.models._opensfm_values import motion_of, table_in
from epipole.scene import Frames, Reconstruction, Rigs

_SAME_POSE = 1e-4
"""Difference, relative for translations, up to which an image's pose agrees with that of its rig."""


@dataclass(frozen=True, slots=True, eq=False)
class RigColumns:
    """Rigs and frames, and for each image its frame and sensor."""

    rigs: Rigs
    frames: Frames
    frame: np.ndarray
    sensor: np.ndarray


def rigs_and_frames(
    content: Mapping[str, Any],
    names: list[str],
    camera_rows: np.ndarray,
    cams_from_world: Rigid3,
    timestamp_s: np.ndarray,
) -> RigColumns:
    """The rigs of a reconstruction, and single cameras for all other images.

    Args:
        content: the reconstruction.
        names: of the images.
        camera_rows: camera of each image.
        cams_from_world: pose of each image.
        timestamp_s: of each image, NaN if unknown.

    Raises:
        ConfigError: an image's pose contradicts that of its rig.
    """
    instances, rig_cameras = table_in(content, "rig_instances"), table_in(content, "rig_cameras")
    mounted = _mounted_images(instances, rig_cameras, names)
    mountings = {key: motion_of(rig_cameras[key], f"rig camera {key[:60]!r}") for key in _used(mounted)}
    sensors, cams_from_rig = _sensors(mounted, mountings, camera_rows)
    row_of_sensor = {key: row for row, key in enumerate(key for rig in sensors for key in rig)}
    rig_of_sensor = [rig for rig, keys in enumerate(sensors) for _ in keys]
    frame, sensor = np.empty(len(names), np.int32), np.empty(len(names), np.int32)
    frame_of_instance: dict[str, int] = {}
    rig: list[int] = []
    world: list[Rigid3] = []
    times: list[float] = []
    for image in range(len(names)):
        instance, key = mounted.get(image, ("", ""))
        sensor[image] = row_of_sensor[key, int(camera_rows[image])]
        rig_from_cam = cams_from_rig[int(sensor[image])].inverse()
        if not instance or instance not in frame_of_instance:
            if instance:
                frame_of_instance[instance] = len(rig)
            frame[image] = len(rig)
            rig.append(rig_of_sensor[int(sensor[image])])
            world.append(rig_from_cam @ cams_from_world[image])
            times.append(timestamp_s[image])
            continue
        frame[image] = frame_of_instance[instance]
        difference = world[frame[image]] @ (rig_from_cam @ cams_from_world[image]).inverse()
        distance = float(np.linalg.norm(world[frame[image]].translation))
        if not np.abs(difference.as_matrix() - np.eye(4)).max() <= _SAME_POSE * max(1.0, distance):
            raise ConfigError(
                f"the pose of the image {names[image][:80]!r} contradicts the pose of its rig {instance[:40]!r}"
            )
    first = np.cumsum([0, *map(len, sensors)]).astype(np.int32)
    cameras = np.array([camera for keys in sensors for _, camera in keys], np.int32)
    rigs = Rigs(first, cameras, Rigid3.stack(cams_from_rig))
    return RigColumns(
        rigs, Frames(np.array(rig, np.int32), Rigid3.stack(world), np.array(times)), frame, sensor
    )


def _mounted_images(
    instances: Mapping[str, Any], rig_cameras: Mapping[str, Any], names: list[str]
) -> dict[int, tuple[str, str]]:
    """Instance and rig camera of each image that belongs to an instance with several images."""
    row_of_image = {name: row for row, name in enumerate(names)}
    out: dict[int, tuple[str, str]] = {}
    for instance, values in instances.items():
        members = table_in(values, "rig_camera_ids") if isinstance(values, dict) else {}
        known = {name: key for name, key in members.items() if name in row_of_image}
        if len(known) < 2 or not rig_cameras:
            continue
        for name, key in known.items():
            if not isinstance(key, str) or key not in rig_cameras:
                raise ConfigError(
                    f"image {name[:80]!r} has the rig camera {str(key)[:60]!r}, which does not exist"
                )
            if row_of_image[name] in out:
                raise ConfigError(f"image {name[:80]!r} belongs to two rig instances")
            if list(known.values()).count(key) > 1:
                raise ConfigError(
                    f"two images of rig instance {instance[:40]!r} have the rig camera {key[:60]!r}"
                )
            out[row_of_image[name]] = (instance, key)
    return out


def _used(mounted: Mapping[int, tuple[str, str]]) -> dict[str, None]:
    return dict.fromkeys(key for _, key in mounted.values())


def _sensors(
    mounted: Mapping[int, tuple[str, str]], mountings: Mapping[str, Rigid3], camera_rows: np.ndarray
) -> tuple[list[list[tuple[str, int]]], list[Rigid3]]:
    """Of each rig its sensors, as (rig camera, camera), and cam_from_rig of all of them.

    Rig cameras that share an instance are of one rig. Images without a rig have the rig camera "".
    """
    rig_of: dict[str, str] = {key: key for key in mountings}
    first_of_instance: dict[str, str] = {}
    for instance, key in mounted.values():
        one, other = rig_of[key], rig_of[first_of_instance.setdefault(instance, key)]
        if one != other:
            rig_of = {each: other if rig == one else rig for each, rig in rig_of.items()}
    rigs: dict[tuple[str, int], list[tuple[str, int]]] = {}
    for image, camera in enumerate(camera_rows.tolist()):
        key = mounted[image][1] if image in mounted else ""
        keys = rigs.setdefault((rig_of[key], -1) if key else ("", camera), [])
        if (key, camera) not in keys:
            keys.append((key, camera))
    poses = []
    for keys in rigs.values():
        reference = mountings[keys[0][0]].inverse() if keys[0][0] else Rigid3.identity()
        poses += [mountings[key] @ reference if k else Rigid3.identity() for k, (key, _) in enumerate(keys)]
    return list(rigs.values()), poses


def rig_content(model: Reconstruction, is_written: np.ndarray) -> dict[str, Any]:
    """`rig_cameras` and `rig_instances` of a model with rigs; empty for a model of single cameras.

    Args:
        model: the model.
        is_written: mask of its images that have a pose.
    """
    if not (np.diff(model.rigs.sensor_offsets) > 1).any():
        return {}
    sensors = np.unique(model.images.sensor[is_written]).tolist()
    content: dict[str, Any] = {"rig_cameras": {}, "rig_instances": {}}
    for sensor in sensors:
        content["rig_cameras"][f"sensor {sensor}"] = _values_of(model.rigs.cam_from_rig[sensor])
    for image in np.flatnonzero(is_written).tolist():
        frame = int(model.images.frame[image])
        instance = content["rig_instances"].setdefault(
            f"frame {frame}", {**_values_of(model.frames.rig_from_world[frame]), "rig_camera_ids": {}}
        )
        instance["rig_camera_ids"][model.images.name[image]] = f"sensor {model.images.sensor[image]}"
    return content


def _values_of(motion: Rigid3) -> dict[str, Any]:
    return {
        "rotation": Rotation3(motion.rotation).log().tolist(),
        "translation": motion.translation.tolist(),
    }
