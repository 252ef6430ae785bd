"""Reading and writing COLMAP's text model files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np

from epipole.cameras import CameraModel
from epipole.errors import ConfigError, FileFormatError
from epipole.io.colmap import _tables as tables
from epipole.io.colmap.cameras import model_id_named, unknown_model
from epipole.io.files import file_text, problem_of_name

Record = TypeVar("Record")

_HEADERS = {
    "cameras": ("Camera list, one line for each", "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"),
    "rigs": (
        "Rig list, one line for each",
        "RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, "
        "SENSORS[] as (SENSOR_TYPE, SENSOR_ID, HAS_POSE, [QW, QX, QY, QZ, TX, TY, TZ])",
    ),
    "frames": (
        "Frame list, one line for each",
        "FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW, QX, QY, QZ, TX, TY, TZ], NUM_DATA_IDS, "
        "DATA_IDS[] as (SENSOR_TYPE, SENSOR_ID, DATA_ID)",
    ),
    "images": (
        "Image list, two lines for each",
        "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME / POINTS2D[] as (X, Y, POINT3D_ID)",
    ),
    "points3D": (
        "Point list, one line for each",
        "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
    ),
}


def read_text(folder: Path) -> tables.ColmapTables:
    """Read the .txt files of a folder."""
    with_rigs = (folder / "rigs.txt").is_file() and (folder / "frames.txt").is_file()
    return tables.ColmapTables(
        cameras=_records(folder / "cameras.txt", _camera, "a camera"),
        rigs=_records(folder / "rigs.txt", _rig, "a rig") if with_rigs else None,
        frames=_records(folder / "frames.txt", _frame, "a frame") if with_rigs else None,
        images=_images(folder / "images.txt"),
        points=_point_table(_records(folder / "points3D.txt", _point, "a point")),
    )


def _records(path: Path, parse: Callable[[str], Record], what: str) -> list[Record]:
    lines = enumerate(file_text(path).split("\n"), 1)
    return [_parsed(path, number, parse, line, what) for number, line in lines if _has_content(line)]


def _has_content(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _parsed(path: Path, number: int, parse: Callable[[str], Record], line: str, what: str) -> Record:
    try:
        return parse(line)
    except ConfigError as error:
        raise FileFormatError(path, f"line {number}: {error}") from error
    except (ValueError, IndexError, OverflowError) as error:
        shown = line.strip()[:60]
        raise FileFormatError(path, f"line {number}: not {what}: {shown!r}") from error


def _floats(words: list[str], count: int) -> np.ndarray:
    if len(words) < count:
        raise ValueError("too few numbers")
    return np.array(words[:count], np.float64)


def _id(word: str) -> int:
    """An id or an index: 32 bits in COLMAP, 64 for points, -1 for none."""
    number = int(word)
    if not -1 <= number < 2**63:
        raise ValueError("not an id")
    return number


def _sensor_type(word: str) -> int:
    return tables.SENSOR_TYPES.index(word)


def _camera(line: str) -> tables.CameraRecord:
    camera_id, model_name, width, height, *params = line.split()
    model_id = model_id_named(model_name)
    if model_id is None:
        raise ConfigError(unknown_model(model_name))
    return tables.CameraRecord(
        _id(camera_id), model_id, int(width), int(height), _floats(params, len(params))
    )


def _rig(line: str) -> tables.RigRecord:
    rig_id, num_sensors, *words = line.split()
    sensors = []
    for position in range(_id(num_sensors)):
        sensor_type, sensor_id, pose = _sensor_type(words[0]), _id(words[1]), tables.IDENTITY_POSE
        words = words[2:]
        if position > 0:
            has_pose = int(words[0]) != 0
            pose = _floats(words[1:], 7) if has_pose else tables.UNKNOWN_POSE
            words = words[8:] if has_pose else words[1:]
        sensors.append(tables.SensorRecord(sensor_type, sensor_id, pose))
    if words:
        raise ValueError("the number of sensors does not match")
    return tables.RigRecord(_id(rig_id), tuple(sensors))


def _frame(line: str) -> tables.FrameRecord:
    words = line.split()
    pose, rest = _floats(words[2:], 7), words[10:]
    if len(rest) != 3 * _id(words[9]):
        raise ValueError("the number of images does not match")
    data = tuple(
        tables.DataRecord(_sensor_type(a), _id(b), _id(c))
        for a, b, c in zip(rest[::3], rest[1::3], rest[2::3])
    )
    return tables.FrameRecord(_id(words[0]), _id(words[1]), pose, data)


def _images(path: Path) -> list[tables.ImageRecord]:
    """Every image has two lines; the second one may be empty."""
    lines = file_text(path).split("\n")
    images, row = [], 0
    while row < len(lines):
        if not _has_content(lines[row]):
            row += 1
            continue
        head = _parsed(path, row + 1, _image_head, lines[row], "an image")
        second = lines[row + 1] if row + 1 < len(lines) else ""
        xy, point_ids = _parsed(path, row + 2, _keypoints, second, "a list of keypoints")
        images.append(tables.ImageRecord(*head, xy, point_ids))
        row += 2
    return images


def _image_head(line: str) -> tuple[int, np.ndarray, int, str]:
    # The name is the rest of the line, since it may contain spaces.
    words = line.strip().split(maxsplit=9)
    if (problem := problem_of_name(words[9])) is not None:
        raise ConfigError(problem)
    return _id(words[0]), _floats(words[1:], 7), _id(words[8]), words[9]


def _keypoints(line: str) -> tuple[np.ndarray, np.ndarray]:
    words = line.split()
    if len(words) % 3:
        raise ValueError("expected three numbers per keypoint")
    xy = np.array([words[0::3], words[1::3]], np.float64).T.reshape(-1, 2)
    return xy, np.array([_id(word) for word in words[2::3]], np.int64)


def _point(line: str) -> tuple[int, np.ndarray, list[int], list[int]]:
    words = line.split()
    numbers, track = _floats(words[1:], 7), [_id(word) for word in words[8:]]
    if len(track) % 2:
        raise ValueError("expected two numbers per observation")
    return _id(words[0]), numbers, [int(word) for word in words[4:7]], track


def _point_table(rows: list[tuple[int, np.ndarray, list[int], list[int]]]) -> tables.PointTable:
    numbers = np.array([row[1] for row in rows]).reshape(-1, 7)
    lengths = [len(row[3]) // 2 for row in rows]
    track = np.array([number for row in rows for number in row[3]], np.int64).reshape(-1, 2)
    return tables.PointTable(
        ids=np.array([row[0] for row in rows], np.int64),
        xyz=numbers[:, :3].copy(),
        rgb=np.clip(np.array([row[2] for row in rows]).reshape(-1, 3), 0, 255).astype(np.uint8),
        error=numbers[:, 6].copy(),
        track_offsets=np.concatenate([[0], np.cumsum(np.array(lengths, np.int64))]).astype(np.int64),
        track_image_ids=track[:, 0].copy(),
        track_keypoints=track[:, 1].copy(),
    )


def write_text(tables: tables.ColmapTables, folder: Path) -> None:
    """Write the five .txt files into a folder."""
    rigs, frames = tables.rigs or [], tables.frames or []
    _write(folder, "cameras", len(tables.cameras), (_camera_line(camera) for camera in tables.cameras))
    _write(folder, "rigs", len(rigs), (_rig_line(rig) for rig in rigs))
    _write(folder, "frames", len(frames), (_frame_line(frame) for frame in frames))
    _write(folder, "images", len(tables.images), (_image_lines(image) for image in tables.images))
    _write(folder, "points3D", len(tables.points.ids), _point_lines(tables.points))


def _write(folder: Path, name: str, number: int, lines: Iterator[str]) -> None:
    with (folder / f"{name}.txt").open("w", encoding="utf-8", newline="\n") as stream:
        stream.writelines(f"# {line}\n" for line in (*_HEADERS[name], f"Number: {number}"))
        stream.writelines(f"{line}\n" for line in lines)


def _joined(*values: object) -> str:
    """Values separated by spaces; floats have enough digits to be read back exactly."""
    words = (repr(float(v)) if isinstance(v, float) else str(v) for v in values)
    return " ".join(words)


def _camera_line(camera: tables.CameraRecord) -> str:
    name = CameraModel(camera.model_id).name
    return _joined(camera.id, name, camera.width, camera.height, *camera.params.tolist())


def _rig_line(rig: tables.RigRecord) -> str:
    words: list[object] = [rig.id, len(rig.sensors)]
    for position, sensor in enumerate(rig.sensors):
        words += [tables.SENSOR_TYPES[sensor.type], sensor.id]
        if position > 0:
            has_pose = bool(np.isfinite(sensor.sensor_from_rig).all())
            words += [1, *sensor.sensor_from_rig.tolist()] if has_pose else [0]
    return _joined(*words)


def _frame_line(frame: tables.FrameRecord) -> str:
    data = [word for d in frame.data for word in (tables.SENSOR_TYPES[d.sensor_type], d.sensor_id, d.data_id)]
    return _joined(frame.id, frame.rig_id, *frame.rig_from_world.tolist(), len(frame.data), *data)


def _image_lines(image: tables.ImageRecord) -> str:
    head = _joined(image.id, *image.cam_from_world.tolist(), image.camera_id, image.name)
    rows = zip(image.keypoints.tolist(), image.point_ids.tolist())
    return head + "\n" + " ".join(f"{x!r} {y!r} {point}" for (x, y), point in rows)


def _point_lines(points: tables.PointTable) -> Iterator[str]:
    track = np.stack([points.track_image_ids, points.track_keypoints], axis=1)
    columns = (
        points.ids,
        points.xyz,
        points.rgb,
        points.error,
        points.track_offsets[:-1],
        points.track_offsets[1:],
    )
    for point_id, xyz, rgb, error, start, stop in zip(*(column.tolist() for column in columns)):
        yield _joined(point_id, *xyz, *rgb, error, *track[start:stop].ravel().tolist())
