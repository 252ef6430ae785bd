"""Which rig, sensor and frame each image belongs to, by its name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int32

from epipole.cameras import Camera
from epipole.errors import ConfigError
from epipole.io.colmap.rig_config import RigConfig, RigSensor
from epipole.io.images.photographs import PhotographHeader
from epipole.pipelines.sfm.cameras import GroupedCameras
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.scene import Cameras


@dataclass(frozen=True, slots=True, eq=False)
class RigAssignment:
    """Sensor and frame of each image; -1 for images of no rig."""

    sensors: tuple[RigSensor, ...]
    """Of all rigs, one rig after another; the first of each rig is its reference."""
    rig_of_sensor: Int32[np.ndarray, " s"]
    sensor: Int32[np.ndarray, " n"]
    frame: Int32[np.ndarray, " n"]
    """Images of one rig whose names differ only in the prefix, or agree in the wildcards, have the same frame."""

    def reference_of(self, sensor: int) -> int:
        """The reference of a sensor's rig: its first sensor."""
        return int(np.flatnonzero(self.rig_of_sensor == self.rig_of_sensor[sensor])[0])

    def notes_on_names(self, names: Sequence[str]) -> list[str]:
        """A note on images whose names are none of those in the rig file."""
        others = np.flatnonzero(self.sensor < 0)
        if not len(others):
            return []
        return [
            f"{len(others)} of {len(names)} images are of no rig, because no camera of the rig file has their names "
            f"({names[others[0]]}{' and so on' if len(others) > 1 else ''})"
        ]


def assign_images(names: Sequence[str], rigs: Sequence[RigConfig]) -> RigAssignment:
    """Find the sensor and the frame of each image; the longest prefix or pattern counts.

    Raises:
        ConfigError: a prefix or pattern matches no image.
    """
    sensors = [sensor for rig in rigs for sensor in rig.sensors]
    rig_of_sensor = np.repeat(np.arange(len(rigs)), [len(rig.sensors) for rig in rigs]).astype(np.int32)
    sensor, frame = np.full(len(names), -1, np.int32), np.full(len(names), -1, np.int32)
    frames: dict[tuple[int, tuple[str, ...]], int] = {}
    for k, name in enumerate(names):
        rests = {s: rest for s, one in enumerate(sensors) if (rest := one.images.rest_of(name)) is not None}
        if not rests:
            continue
        best = max(rests, key=lambda s: sensors[s].images.num_fixed)
        sensor[k] = best
        frame[k] = frames.setdefault((int(rig_of_sensor[best]), rests[best]), len(frames))
    for s, one in enumerate(sensors):
        if not (sensor == s).any():
            raise ConfigError(
                f"no image name has the {one.images.in_words} of the rigs; the names are {', '.join(names[:3])} and so on"
            )
    return RigAssignment(tuple(sensors), rig_of_sensor, sensor, frame)


def with_rig_cameras(
    grouped: GroupedCameras,
    headers: Mapping[str, PhotographHeader],
    rigs: Sequence[RigConfig],
    config: ReconstructConfig,
) -> GroupedCameras:
    """Give each sensor its own camera, with the intrinsics of the rig file where it has them.

    Raises:
        ConfigError: a prefix or pattern matches no image, or images of one sensor with known intrinsics have different sizes.
    """
    assignment = assign_images(tuple(headers), rigs)
    rows, out = list(range(len(grouped.cameras))), grouped.camera_of_image.copy()
    known: dict[int, Camera] = {}
    sources, each = list(grouped.sources), list(headers.values())
    for s, sensor in enumerate(assignment.sensors):
        own = np.flatnonzero(assignment.sensor == s)
        for camera in np.unique(grouped.camera_of_image[own]).tolist():
            row = len(rows)
            rows.append(camera)
            sources.append(grouped.sources[camera])
            out[own[grouped.camera_of_image[own] == camera]] = row
            if sensor.camera_model is not None:
                known[row] = _known_camera(sensor, [each[k] for k in own])
                sources[row] = "given by the rig file"
    columns = {name: getattr(grouped.cameras, name)[np.array(rows)] for name in grouped.cameras.__slots__}
    for row, camera in known.items():
        columns["model"][row], columns["params"][row] = int(camera.model), camera.padded_params()
        columns["is_focal_trusted"][row], columns["is_constant"][row] = True, not config.refine_known
    used = np.unique(out)
    new = np.full(len(rows), -1, np.int32)
    new[used] = np.arange(len(used))
    cameras = Cameras(**{name: column[used] for name, column in columns.items()})
    return replace(
        grouped, cameras=cameras, camera_of_image=new[out], sources=tuple(sources[k] for k in used.tolist())
    )


def _known_camera(sensor: RigSensor, headers: Sequence[PhotographHeader]) -> Camera:
    sizes = sorted({(header.width, header.height) for header in headers})
    if len(sizes) > 1:
        raise ConfigError(
            f"the images with the {sensor.images.in_words} have known intrinsics, but different sizes: "
            f"{', '.join(f'{w}x{h}' for w, h in sizes)}"
        )
    assert sensor.camera_model is not None
    width, height = sizes[0]
    return Camera(sensor.camera_model, width, height, np.array(sensor.params))
