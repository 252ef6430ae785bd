"""Reading and writing COLMAP's binary model files (little endian)."""

from __future__ import annotations

import struct
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np

from epipole.io._bytes import ByteReader
from epipole.io.colmap import _tables as tables
from epipole.io.colmap.cameras import num_params_of, unknown_model
from epipole.io.files import file_bytes, problem_of_name

Table = TypeVar("Table")

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters
_ID_AND_NUMBER = struct.Struct("<II")
_SENSOR = struct.Struct("<iI")  # type, id
_HAS_POSE = struct.Struct("<B")
_POSE = struct.Struct("<7d")
_DATA = struct.Struct("<iIQ")  # sensor type, sensor id, image id
_IMAGE = struct.Struct("<I7dI")  # id, pose, camera id; then the name and the keypoints
_KEYPOINT = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_POINT = np.dtype([("id", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])
_OBSERVATION = np.dtype([("image", "<u4"), ("keypoint", "<u4")])


def read_binary(folder: Path) -> tables.ColmapTables:
    """Read the .bin files of a folder."""
    with_rigs = (folder / "rigs.bin").is_file() and (folder / "frames.bin").is_file()
    return tables.ColmapTables(
        cameras=_read(folder / "cameras.bin", _read_cameras),
        rigs=_read(folder / "rigs.bin", _read_rigs) if with_rigs else None,
        frames=_read(folder / "frames.bin", _read_frames) if with_rigs else None,
        images=_read(folder / "images.bin", _read_images),
        points=_read(folder / "points3D.bin", _read_points),
    )


def read_binary_points(path: Path) -> tables.PointTable:
    """Read only points3D.bin."""
    return _read(path, _read_points)


def _read(path: Path, parse: Callable[[ByteReader], Table]) -> Table:
    reader = ByteReader(path, file_bytes(path))
    table = parse(reader)
    reader.finish()
    return table


def _read_cameras(reader: ByteReader) -> list[tables.CameraRecord]:
    cameras = []
    for _ in range(reader.count(_CAMERA.size, "cameras")):
        camera_id, model_id, width, height = reader.values(_CAMERA, "a camera")
        num_params = num_params_of(model_id)
        if num_params is None:
            raise reader.fail(f"camera {camera_id}: {unknown_model(model_id)}")
        params = reader.array("<f8", num_params, "a camera's parameters")
        cameras.append(tables.CameraRecord(camera_id, model_id, width, height, params))
    return cameras


def _read_rigs(reader: ByteReader) -> list[tables.RigRecord]:
    rigs = []
    for _ in range(reader.count(_ID_AND_NUMBER.size, "rigs")):
        rig_id, num_sensors = reader.values(_ID_AND_NUMBER, "a rig")
        reader.require_room(num_sensors, _SENSOR.size, "sensors")
        sensors = []
        for position in range(num_sensors):
            sensor_type, sensor_id = reader.values(_SENSOR, "a sensor")
            pose = tables.IDENTITY_POSE
            if position > 0:
                (has_pose,) = reader.values(_HAS_POSE, "a sensor")
                pose = reader.array("<f8", 7, "a sensor's pose") if has_pose else tables.UNKNOWN_POSE
            sensors.append(tables.SensorRecord(sensor_type, sensor_id, pose))
        rigs.append(tables.RigRecord(rig_id, tuple(sensors)))
    return rigs


def _read_frames(reader: ByteReader) -> list[tables.FrameRecord]:
    frames = []
    for _ in range(reader.count(_ID_AND_NUMBER.size + _POSE.size, "frames")):
        frame_id, rig_id = reader.values(_ID_AND_NUMBER, "a frame")
        pose = reader.array("<f8", 7, "a frame's pose")
        (num_data,) = reader.values(struct.Struct("<I"), "a frame")
        reader.require_room(num_data, _DATA.size, "images of a frame")
        data = tuple(tables.DataRecord(*reader.values(_DATA, "a frame")) for _ in range(num_data))
        frames.append(tables.FrameRecord(frame_id, rig_id, pose, data))
    return frames


def _read_images(reader: ByteReader) -> list[tables.ImageRecord]:
    images = []
    for _ in range(reader.count(_IMAGE.size + 1 + _COUNT.size, "images")):
        image_id, *pose, camera_id = reader.values(_IMAGE, "an image")
        name = reader.string("an image's name")
        if (problem := problem_of_name(name)) is not None:
            raise reader.fail(problem)
        keypoints = reader.array(_KEYPOINT, reader.count(_KEYPOINT.itemsize, "keypoints"), "keypoints")
        images.append(
            tables.ImageRecord(image_id, np.array(pose), camera_id, name, keypoints["xy"], keypoints["point"])
        )
    return images


def _read_points(reader: ByteReader) -> tables.PointTable:
    """Points vary in length: one pass finds where each starts, the rest works on columns."""
    data, heads, tracks = reader.data, [], []
    for _ in range(reader.count(_POINT.itemsize, "points")):
        start = reader.advance(_POINT.itemsize, "a point")
        (length,) = _COUNT.unpack_from(data, start + _POINT.itemsize - _COUNT.size)
        reader.require_room(length, _OBSERVATION.itemsize, "observations of a point")
        end = reader.position + length * _OBSERVATION.itemsize
        heads.append(data[start : reader.position])
        tracks.append(data[reader.position : end])
        reader.position = end
    points = np.frombuffer(b"".join(heads), _POINT)
    observations = np.frombuffer(b"".join(tracks), _OBSERVATION)
    return tables.PointTable(
        ids=points["id"].astype(np.int64),
        xyz=points["xyz"].astype(np.float64),
        rgb=points["rgb"].copy(),
        error=points["error"].astype(np.float64),
        track_offsets=np.concatenate([[0], np.cumsum(points["length"].astype(np.int64))]),
        track_image_ids=observations["image"].astype(np.int64),
        track_keypoints=observations["keypoint"].astype(np.int64),
    )


def write_binary(tables: tables.ColmapTables, folder: Path) -> None:
    """Write the five .bin files into a folder."""
    (folder / "cameras.bin").write_bytes(
        _COUNT.pack(len(tables.cameras))
        + b"".join(_CAMERA.pack(*c[:4]) + c.params.astype("<f8").tobytes() for c in tables.cameras)
    )
    (folder / "rigs.bin").write_bytes(_rig_bytes(tables.rigs or []))
    (folder / "frames.bin").write_bytes(_frame_bytes(tables.frames or []))
    with (folder / "images.bin").open("wb") as stream:
        stream.write(_COUNT.pack(len(tables.images)))
        for image in tables.images:
            stream.write(_image_bytes(image))
    (folder / "points3D.bin").write_bytes(_point_bytes(tables.points))


def _rig_bytes(rigs: list[tables.RigRecord]) -> bytes:
    out = [_COUNT.pack(len(rigs))]
    for rig in rigs:
        out.append(_ID_AND_NUMBER.pack(rig.id, len(rig.sensors)))
        for position, sensor in enumerate(rig.sensors):
            out.append(_SENSOR.pack(sensor.type, sensor.id))
            if position > 0:
                has_pose = bool(np.isfinite(sensor.sensor_from_rig).all())
                out.append(_HAS_POSE.pack(has_pose))
                out.append(_POSE.pack(*sensor.sensor_from_rig) if has_pose else b"")
    return b"".join(out)


def _frame_bytes(frames: list[tables.FrameRecord]) -> bytes:
    out = [_COUNT.pack(len(frames))]
    for frame in frames:
        out.append(_ID_AND_NUMBER.pack(frame.id, frame.rig_id) + _POSE.pack(*frame.rig_from_world))
        out.append(struct.pack("<I", len(frame.data)))
        out.extend(_DATA.pack(*data) for data in frame.data)
    return b"".join(out)


def _image_bytes(image: tables.ImageRecord) -> bytes:
    keypoints = np.empty(len(image.keypoints), _KEYPOINT)
    keypoints["xy"], keypoints["point"] = image.keypoints, image.point_ids
    head = _IMAGE.pack(image.id, *image.cam_from_world, image.camera_id)
    return head + image.name.encode() + b"\0" + _COUNT.pack(len(keypoints)) + keypoints.tobytes()


def _point_bytes(points: tables.PointTable) -> bytes:
    heads = np.empty(len(points.ids), _POINT)
    heads["id"], heads["xyz"], heads["rgb"], heads["error"] = points.ids, points.xyz, points.rgb, points.error
    heads["length"] = np.diff(points.track_offsets)
    observations = np.empty(len(points.track_image_ids), _OBSERVATION)
    observations["image"], observations["keypoint"] = points.track_image_ids, points.track_keypoints
    head_bytes, track_bytes = heads.tobytes(), observations.tobytes()
    edges = (points.track_offsets * _OBSERVATION.itemsize).tolist()
    out, size = [_COUNT.pack(len(heads))], _POINT.itemsize
    for row, (start, stop) in enumerate(pairwise(edges)):
        out.append(head_bytes[row * size : (row + 1) * size])
        out.append(track_bytes[start:stop])
    return b"".join(out)
