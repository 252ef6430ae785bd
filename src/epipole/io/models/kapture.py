"""Kapture 1.1 (Naver Labs), a folder of tables: sensors, rigs, trajectories, images, points and keypoints.

Poses are world to sensor (or rig), and rig to sensor, as quaternion (w first) and translation. Camera models, pixels and
axes are those of COLMAP: the center of the top-left pixel is (0.5, 0.5). A timestamp may be any number that identifies
an instant, so it is not read as a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from epipole._checks import checked
from epipole.cameras import Camera
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3
from epipole.io.atomic import atomic_folder
from epipole.io.colmap.cameras import camera_from_colmap, model_id_named, params_to_colmap, unknown_model
from epipole.io.colmap.model import pose_numbers
from epipole.io.files import problem_of_name
from epipole.io.models._kapture_keypoints import observations_in, points_in, write_points
from epipole.io.models._kapture_tables import TableRow, require_writable, rows_of, table_text
from epipole.io.models.model_file import ModelFile, no_tracks, with_observations
from epipole.scene import Cameras, Frames, Images, Reconstruction, Rigs

SENSORS, RIGS = "sensors/sensors.txt", "sensors/rigs.txt"
TRAJECTORIES, RECORDS = "sensors/trajectories.txt", "sensors/records_camera.txt"
IMAGES = "sensors/records_data"
"""Folder of the images."""
_CAMERA, _POSE_COLUMNS = "camera", "qw, qx, qy, qz, tx, ty, tz"


@checked
def write_kapture(reconstruction: Reconstruction, folder: str | Path) -> None:
    """Write the registered images, their cameras, rigs and keypoints, and the points with their tracks.

    Instants are numbered. A camera shared by several sensors is written once per sensor.

    Args:
        reconstruction: the model to write.
        folder: the dataset; images belong to `sensors/records_data` in it.

    Raises:
        ConfigError: an image's name cannot be written.
        WorkspaceError: the folder cannot be written.
    """
    model = reconstruction
    registered = np.flatnonzero(model.is_registered()).tolist()
    require_writable(model.images.name[image] for image in registered)
    frames = sorted({int(model.images.frame[image]) for image in registered})
    tables = {SENSORS: _sensor_rows(model), RECORDS: [], TRAJECTORIES: []}
    sizes = np.diff(model.rigs.sensor_offsets)
    poses = pose_numbers(model.frames.rig_from_world).tolist()
    for frame in frames:
        rig = int(model.frames.rig[frame])
        device = f"rig{rig}" if sizes[rig] > 1 else f"cam{model.rigs.sensor_offsets[rig]}"
        tables[TRAJECTORIES].append([frame, device, *poses[frame]])
    for image in registered:
        row = [int(model.images.frame[image]), f"cam{model.images.sensor[image]}", model.images.name[image]]
        tables[RECORDS].append(row)
    rig_rows = _rig_rows(model.rigs)
    columns = {
        SENSORS: "sensor_id, name, sensor_type, [sensor_params]+",
        TRAJECTORIES: f"timestamp, device_id, {_POSE_COLUMNS}",
        RECORDS: "timestamp, device_id, image_path",
        RIGS: f"rig_id, sensor_id, {_POSE_COLUMNS}",
    }
    if rig_rows:
        tables[RIGS] = rig_rows
    with atomic_folder(folder) as part:
        (part / SENSORS).parent.mkdir()
        for name, rows in tables.items():
            (part / name).write_text(table_text(columns[name], rows), encoding="utf-8", newline="\n")
        write_points(model, part, registered)


def _sensor_rows(model: Reconstruction) -> list[list[object]]:
    rows: list[list[object]] = []
    for sensor, row in enumerate(model.rigs.sensor_camera.tolist()):
        camera = model.cameras[row]
        params = params_to_colmap(camera.model, camera.params).tolist()
        size = [camera.width, camera.height]
        rows.append([f"cam{sensor}", f"camera {row}", _CAMERA, camera.model.name, *size, *params])
    return rows


def _rig_rows(rigs: Rigs) -> list[list[object]]:
    poses = pose_numbers(rigs.cam_from_rig).tolist()
    return [
        [f"rig{rig}", f"cam{sensor}", *poses[sensor]]
        for rig, (start, stop) in enumerate(pairwise(rigs.sensor_offsets.tolist()))
        for sensor in range(start, stop)
        if stop - start > 1
    ]


@checked
def read_kapture(folder: str | Path) -> Reconstruction:
    """Read the images with a pose, their cameras and rigs, and points and tracks if there are any.

    Issues a Python warning for everything in `ModelFile.warnings`.

    Args:
        folder: the dataset, which contains `sensors/sensors.txt`.

    Raises:
        FileFormatError: a table is missing or of another version, a value is invalid, or a camera model is not supported.
    """
    return kapture_contents(folder).warned()


@checked
def kapture_contents(folder: str | Path) -> ModelFile:
    """Read a dataset, and warnings about the content that is not read.

    Args:
        folder: as in `read_kapture`.

    Raises:
        FileFormatError: as in `read_kapture`.
    """
    folder = Path(folder)
    sensors = {row.values[0]: row for row in rows_of(folder / SENSORS) if _is_sensor(row)}
    mounted = _mounted_sensors(folder / RIGS, sensors) if (folder / RIGS).exists() else {}
    poses = _poses(folder / TRAJECTORIES)
    records, num_without = _records(folder / RECORDS, poses, mounted)
    if not records:
        raise FileFormatError(folder / TRAJECTORIES, "none of the images has a pose")
    warnings = [f"images without a pose are not read: {num_without}"] if num_without else []
    names = [record.name for record in records]
    model = _model_of(records, sensors, mounted, folder)
    observations, more = observations_in(folder, names, len(model.points))
    return ModelFile(folder, with_observations(model, observations), (*warnings, *more))


@dataclass(frozen=True, slots=True, eq=False)
class _Record:
    """An image with a pose."""

    name: str
    sensor: str
    rig: str
    """The rig whose pose is known; empty if it is that of the camera."""
    timestamp: int
    device_from_world: Rigid3


def _is_sensor(row: TableRow) -> bool:
    """Whether a row describes a camera; other sensors have no images."""
    row.require(3, "a sensor, its name and its type")
    return row.values[2] == _CAMERA


def _camera_of(row: TableRow) -> Camera:
    row.require(6, "a camera's model, width, height and parameters")
    name = row.values[3].upper()
    model = model_id_named(name)
    if model is None:
        raise row.fail(unknown_model(name))
    size = [row.integer(4, "the width"), row.integer(5, "the height")]
    try:
        return camera_from_colmap(model, size[0], size[1], row.numbers(6))
    except ConfigError as error:
        raise row.fail(str(error)) from error


def _mounted_sensors(path: Path, sensors: dict[str, TableRow]) -> dict[str, dict[str, Rigid3]]:
    """cam_from_rig of the cameras of each rig."""
    rigs: dict[str, dict[str, Rigid3]] = {}
    for row in rows_of(path):
        row.require(2, "a rig, a sensor and a pose")
        rig, sensor = row.values[:2]
        motion = row.motion(2)
        own = rigs.setdefault(rig, {})
        if sensor not in sensors:
            continue  # not a camera
        if motion is None or sensor in own:
            raise row.fail(f"sensor {sensor[:40]!r} has no pose, or two poses, in rig {rig[:40]!r}")
        own[sensor] = motion
    for rig in rigs:
        if any(rig in own for own in rigs.values()) or rig in sensors:
            raise FileFormatError(path, f"rig {rig[:40]!r} is also a sensor; rigs of rigs are not supported")
    return rigs


def _poses(path: Path) -> dict[tuple[int, str], Rigid3]:
    """Pose of each device at each instant, where it is complete."""
    poses = {}
    for row in rows_of(path):
        row.require(2, "a timestamp, a device and a pose")
        key = (row.integer(0, "the timestamp"), row.values[1])
        motion = row.motion(2)
        if key in poses:
            raise row.fail(f"device {key[1][:40]!r} has two poses at {key[0]}")
        if motion is not None:
            poses[key] = motion
    return poses


def _records(
    path: Path, poses: dict[tuple[int, str], Rigid3], mounted: dict[str, dict[str, Rigid3]]
) -> tuple[list[_Record], int]:
    """The images that have a pose, or whose rig has one, and the number of the others."""
    rigs_of: dict[str, list[str]] = {}
    for rig, own in mounted.items():
        for sensor in own:
            rigs_of.setdefault(sensor, []).append(rig)
    out, num_without = [], 0
    seen = set()
    for row in rows_of(path):
        row.require(3, "a timestamp, a device and an image")
        timestamp, (sensor, name) = row.integer(0, "the timestamp"), row.values[1:3]
        if (problem := problem_of_name(name)) is not None:
            raise row.fail(problem)
        if name in seen or (timestamp, sensor) in seen:
            raise row.fail(f"two images have the name {name[:80]}, or are of one sensor and instant")
        seen |= {name, (timestamp, sensor)}
        devices = [("", sensor), *((rig, rig) for rig in rigs_of.get(sensor, []))]
        found = next(
            ((rig, poses[timestamp, key]) for rig, key in devices if (timestamp, key) in poses), None
        )
        if found is None:
            num_without += 1
        else:
            out.append(_Record(name, sensor, found[0], timestamp, found[1]))
    return out, num_without


def _model_of(
    records: list[_Record],
    rows: dict[str, TableRow],
    mounted: dict[str, dict[str, Rigid3]],
    folder: Path,
) -> Reconstruction:
    """A model without keypoints. The first camera of a rig becomes its frame."""
    cameras: dict[str, Camera] = {}
    members: dict[str, list[tuple[str, str]]] = {}
    for record in records:
        if record.sensor not in rows:
            raise FileFormatError(
                folder / RECORDS, f"sensor {record.sensor[:40]!r} is not a camera in {SENSORS}"
            )
        if record.sensor not in cameras:
            cameras[record.sensor] = _camera_of(rows[record.sensor])
        own = members.setdefault(record.rig or f"\0{record.sensor}", [])
        if (record.rig, record.sensor) not in own:
            own.append((record.rig, record.sensor))
    sensors = [key for own in members.values() for key in own]
    row_of_sensor, row_of_camera = ({key: row for row, key in enumerate(keys)} for keys in (sensors, cameras))
    references, cams_from_rig = {}, []
    for own in members.values():
        poses = [mounted[rig][sensor] if rig else Rigid3.identity() for rig, sensor in own]
        references[own[0][0] or f"\0{own[0][1]}"] = poses[0]
        cams_from_rig += [Rigid3.identity(), *(pose @ poses[0].inverse() for pose in poses[1:])]
    rig_rows = {key: row for row, key in enumerate(members)}
    frames: dict[tuple[str, int], int] = {}
    rig: list[int] = []
    world: list[Rigid3] = []
    frame: list[int] = []
    for record in records:
        key = record.rig or f"\0{record.sensor}"
        if (key, record.timestamp) not in frames:
            frames[key, record.timestamp] = len(rig)
            rig.append(rig_rows[key])
            world.append(references[key] @ record.device_from_world)
        frame.append(frames[key, record.timestamp])
    first = np.cumsum([0, *map(len, members.values())]).astype(np.int32)
    camera_rows = np.array([row_of_camera[sensor] for _, sensor in sensors], np.int32)
    sensor = np.array([row_of_sensor[record.rig, record.sensor] for record in records], np.int32)
    no_keypoints = np.zeros(len(records) + 1, np.int64)
    names = tuple(record.name for record in records)
    points = points_in(folder)
    return Reconstruction(
        Cameras.from_list(cameras.values()),
        Rigs(first, camera_rows, Rigid3.stack(cams_from_rig)),
        Frames(np.array(rig, np.int32), Rigid3.stack(world), np.full(len(rig), np.nan)),
        Images(names, np.array(frame, np.int32), sensor, no_keypoints, np.empty((0, 2))),
        points,
        no_tracks(len(points)),
    )
