"""Which rig, sensor and frame each image belongs to, by the start of its name."""

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
    """Images of one rig whose names differ only in the prefix have the same frame."""

    def reference_of(self, sensor: int) -> int:
        """The reference of a sensor's rig: its first sensor."""
        return int(np.flatnonzero(self.rig_of_sensor == self.rig_of_sensor[sensor])[0])


def assign_images(names: Sequence[str], rigs: Sequence[RigConfig]) -> RigAssignment:
    """Find the sensor and the frame of each image; the longest prefix counts.

    Raises:
        ConfigError: a prefix matches no image.
    """
    sensors = [sensor for rig in rigs for sensor in rig.sensors]
    rig_of_sensor = np.repeat(np.arange(len(rigs)), [len(rig.sensors) for rig in rigs]).astype(np.int32)
    sensor, frame = np.full(len(names), -1, np.int32), np.full(len(names), -1, np.int32)
    frames: dict[tuple[int, str], int] = {}
    for k, name in enumerate(names):
        own = [s for s, one in enumerate(sensors) if name.startswith(one.prefix)]
        if not own:
            continue
        best = max(own, key=lambda s: len(sensors[s].prefix))
        sensor[k] = best
        key = (int(rig_of_sensor[best]), name[len(sensors[best].prefix) :])
        frame[k] = frames.setdefault(key, len(frames))
    for s, one in enumerate(sensors):
        if not (sensor == s).any():
            raise ConfigError(
                f"no image name starts with the prefix {one.prefix!r} of the rigs; the names are {', '.join(names[:3])} and so on"
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
        ConfigError: a prefix matches no image, or images of one sensor with known intrinsics have different sizes.
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
            f"the images {sensor.prefix}... have known intrinsics, but different sizes: "
            f"{', '.join(f'{w}x{h}' for w, h in sizes)}"
        )
    assert sensor.camera_model is not None
    width, height = sizes[0]
    return Camera(sensor.camera_model, width, height, np.array(sensor.params))
