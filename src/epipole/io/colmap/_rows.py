"""Conversion of COLMAP's records, which refer to each other by id, to rows, with every reference checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int32, Int64

from epipole.cameras import Camera
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.io.colmap._tables import (
    CAMERA_SENSOR,
    CameraRecord,
    ColmapTables,
    FrameRecord,
    ImageRecord,
    PointTable,
    RigRecord,
)
from epipole.io.colmap.cameras import HALF_PIXEL, camera_from_colmap
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks


def reconstruction_of(tables: ColmapTables, folder: Path, suffix: str) -> Reconstruction:
    """Build the model from the files `*.suffix` read from `folder`.

    Raises:
        FileFormatError: a record refers to a missing one, or has invalid values.
    """

    def file(name: str) -> Path:
        return folder / f"{name}.{suffix}"

    images = sorted(tables.images, key=lambda image: image.id)
    rows_of_ids([image.id for image in images], file("images"), "image")
    camera_rows = rows_of_ids([camera.id for camera in tables.cameras], file("cameras"), "camera")
    cameras = cameras_of(tables.cameras, file("cameras"))
    image_ids, camera_ids = [image.id for image in images], [image.camera_id for image in images]
    require_cameras(image_ids, camera_ids, camera_rows, file("images"))
    if tables.rigs is None or tables.frames is None:
        rigs, positions = Rigs.of_single_cameras(len(cameras)), trivial_frames(camera_ids, camera_rows)
        poses = np.array([image.cam_from_world for image in images]).reshape(-1, 7)
        motions = motions_of(poses, [f"image {i}" for i in image_ids], file("images"))
    else:
        layout = rigs_of(tables.rigs, camera_rows, file("rigs"))
        rigs, positions = layout.rigs, frames_of(tables.frames, layout, image_ids, camera_ids, file("frames"))
        frames = sorted(tables.frames, key=lambda frame: frame.id)
        poses = np.array([frame.rig_from_world for frame in frames]).reshape(-1, 7)
        motions = motions_of(poses, [f"frame {frame.id}" for frame in frames], file("frames"))
        motions = layout.reference_from_file_rig[positions.rig_of_frame] @ motions
    image_columns = _images(images, positions)
    points, tracks = _points(tables.points, image_columns, np.array(image_ids, np.int64), file("points3D"))
    timestamps = np.full(len(positions.rig_of_frame), np.nan)
    frame_columns = Frames(positions.rig_of_frame, motions, timestamps)
    return Reconstruction(cameras, rigs, frame_columns, image_columns, points, tracks)


def _require(condition: bool, path: Path, problem: str) -> None:
    if not condition:
        raise FileFormatError(path, problem)


def rows_of_ids(ids: Sequence[int], path: Path, what: str) -> dict[int, int]:
    """Row of each id when sorted.

    Raises:
        FileFormatError: an id is used twice.
    """
    ordered = sorted(ids)
    twice = next((a for a, b in pairwise(ordered) if a == b), None)
    _require(twice is None, path, f"{what} {twice} is defined twice")
    return {identity: row for row, identity in enumerate(ordered)}


def cameras_of(records: list[CameraRecord], path: Path) -> Cameras:
    """Camera columns in the order of the ids; focal lengths are marked as trusted, intrinsics as not constant.

    Raises:
        FileFormatError: a camera has invalid values.
    """
    cameras: list[Camera] = []
    for record in sorted(records, key=lambda camera: camera.id):
        try:
            cameras.append(camera_from_colmap(*record[1:]))
        except ConfigError as error:
            raise FileFormatError(path, f"camera {record.id}: {error}") from error
    return Cameras.from_list(cameras)


def require_cameras(
    image_ids: list[int], camera_ids: list[int], camera_rows: dict[int, int], path: Path
) -> None:
    """Check that every image has a camera.

    Raises:
        FileFormatError: an image refers to a missing camera.
    """
    for image_id, camera_id in zip(image_ids, camera_ids):
        _require(camera_id in camera_rows, path, f"image {image_id}: camera {camera_id} is not defined")


def motions_of(poses: np.ndarray, positions: list[str], path: Path) -> Rigid3:
    """Motions from rows (w, x, y, z, tx, ty, tz); NaN where a row is not finite.

    Raises:
        FileFormatError: a quaternion is far from unit length.
    """
    known = np.isfinite(poses).all(axis=1)
    longest = np.abs(poses[:, :4]).max(axis=1, initial=0.0)
    for row in np.flatnonzero(known & ~((longest > 1e-6) & (longest < 1e6))):
        raise FileFormatError(path, f"{positions[row]}: {poses[row, :4]} is not a unit quaternion")
    rotation, translation = np.full((len(poses), 3, 3), np.nan), np.full((len(poses), 3), np.nan)
    rotation[known] = Rotation3.from_quat_wxyz(poses[known, :4]).matrix
    translation[known] = poses[known, 4:]
    return Rigid3(rotation, translation)


@dataclass(frozen=True, slots=True, eq=False)
class RigLayout:
    """Rigs in rows, with a mapping from the file's ids."""

    rigs: Rigs
    row_of_rig: dict[int, int]
    sensor_of_rig_and_camera: dict[tuple[int, int], int]
    """Sensor row by (rig row, camera id)."""
    reference_from_file_rig: Rigid3
    """For each rig, its first camera from the file's reference sensor, which need not be a camera."""


def rigs_of(records: list[RigRecord], camera_rows: dict[int, int], path: Path) -> RigLayout:
    """The cameras of each rig (other sensors have no images); the first one becomes the reference.

    Raises:
        FileFormatError: a rig refers to a missing camera, or has one twice.
    """
    records = sorted(records, key=lambda rig: rig.id)
    row_of_rig = rows_of_ids([rig.id for rig in records], path, "rig")
    numbers: list[int] = []
    cameras: list[int] = []
    poses: list[np.ndarray] = []
    positions: list[str] = []
    sensor_of: dict[tuple[int, int], int] = {}
    for row, rig in enumerate(records):
        sensors = [sensor for sensor in rig.sensors if sensor.type == CAMERA_SENSOR]
        numbers.append(len(sensors))
        for sensor in sensors:
            _require(sensor.id in camera_rows, path, f"rig {rig.id}: camera {sensor.id} is not defined")
            _require(
                (row, sensor.id) not in sensor_of, path, f"rig {rig.id}: camera {sensor.id} is listed twice"
            )
            sensor_of[row, sensor.id] = len(cameras)
            cameras.append(camera_rows[sensor.id])
            poses.append(sensor.sensor_from_rig)
            positions.append(f"rig {rig.id}")
    offsets = np.concatenate([[0], np.cumsum(numbers)]).astype(np.int32)
    cam_from_file_rig = motions_of(np.array(poses).reshape(-1, 7), positions, path)
    reference_from_file_rig = Rigid3.identity(len(records))
    has_camera = np.diff(offsets) > 0
    first = cam_from_file_rig[offsets[:-1][has_camera]]
    reference_from_file_rig.rotation[has_camera] = first.rotation
    reference_from_file_rig.translation[has_camera] = first.translation
    rig_of_sensor = np.repeat(np.arange(len(records)), numbers)
    cam_from_rig = cam_from_file_rig @ reference_from_file_rig.inverse()[rig_of_sensor]
    rigs = Rigs(offsets, np.array(cameras, np.int32), cam_from_rig)
    return RigLayout(rigs, row_of_rig, sensor_of, reference_from_file_rig)


@dataclass(frozen=True, slots=True, eq=False)
class ImagePoses:
    """The frame and the sensor of each image."""

    rig_of_frame: Int32[np.ndarray, " f"]
    frame_of_image: Int32[np.ndarray, " n"]
    sensor_of_image: Int32[np.ndarray, " n"]


def trivial_frames(camera_ids: list[int], camera_rows: dict[int, int]) -> ImagePoses:
    """One frame for each image, one rig for each camera."""
    rows = np.array([camera_rows[camera_id] for camera_id in camera_ids], np.int32)
    return ImagePoses(rows, np.arange(len(rows), dtype=np.int32), rows.copy())


def frames_of(
    records: list[FrameRecord], layout: RigLayout, image_ids: list[int], camera_ids: list[int], path: Path
) -> ImagePoses:
    """Put images into frames; the rows of both are in the order of their ids.

    Raises:
        FileFormatError: an image is in no frame or in two, or a frame's rig does not have its camera.
    """
    records = sorted(records, key=lambda frame: frame.id)
    rows_of_ids([frame.id for frame in records], path, "frame")
    row_of_image = {image_id: row for row, image_id in enumerate(image_ids)}
    rig_of_frame = np.empty(len(records), np.int32)
    frame_of_image, sensor_of_image = np.full((2, len(image_ids)), -1, np.int32)
    for row, frame in enumerate(records):
        position = f"frame {frame.id}"
        _require(frame.rig_id in layout.row_of_rig, path, f"{position}: rig {frame.rig_id} is not defined")
        rig = rig_of_frame[row] = layout.row_of_rig[frame.rig_id]
        for data in frame.data:
            image = row_of_image.get(data.data_id)
            if data.sensor_type != CAMERA_SENSOR or image is None:
                continue
            sensor = layout.sensor_of_rig_and_camera.get((rig, data.sensor_id), -1)
            fits = sensor >= 0 and camera_ids[image] == data.sensor_id
            is_new = bool(frame_of_image[image] < 0)
            _require(
                fits,
                path,
                f"{position}: image {data.data_id} does not belong to camera {data.sensor_id} of its rig",
            )
            _require(is_new, path, f"{position}: image {data.data_id} is in two frames")
            frame_of_image[image], sensor_of_image[image] = row, sensor
    for lost in np.flatnonzero(frame_of_image < 0):
        raise FileFormatError(path, f"image {image_ids[lost]} belongs to no frame")
    return ImagePoses(rig_of_frame, frame_of_image, sensor_of_image)


def _images(records: list[ImageRecord], positions: ImagePoses) -> Images:
    offsets = np.concatenate([[0], np.cumsum([len(image.keypoints) for image in records])]).astype(np.int64)
    keypoints: Float64[np.ndarray, "m 2"] = np.concatenate(
        [np.empty((0, 2)), *(r.keypoints for r in records)]
    )
    names = tuple(image.name for image in records)
    return Images(names, positions.frame_of_image, positions.sensor_of_image, offsets, keypoints - HALF_PIXEL)


def _points(
    table: PointTable, images: Images, image_ids: Int64[np.ndarray, " n"], path: Path
) -> tuple[Points, Tracks]:
    order = np.argsort(table.ids, kind="stable")
    ids = table.ids[order]
    for row in np.flatnonzero(ids[1:] == ids[:-1]):
        raise FileFormatError(path, f"point {ids[row]} is defined twice")
    lengths = np.diff(table.track_offsets)[order]
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    # Row in the file of every observation, in the new order.
    source = np.repeat(table.track_offsets[:-1][order] - offsets[:-1], lengths) + np.arange(offsets[-1])
    seen_ids, keypoint = table.track_image_ids[source], table.track_keypoints[source]
    image = np.searchsorted(image_ids, seen_ids)
    known = image < len(image_ids)
    known[known] = image_ids[image[known]] == seen_ids[known]
    num_keypoints = np.diff(images.keypoint_offsets)
    fits = known.copy()
    fits[known] = (keypoint[known] >= 0) & (keypoint[known] < num_keypoints[image[known]])
    for k in np.flatnonzero(~fits):
        point = ids[np.searchsorted(offsets, k, side="right") - 1]
        what = "keypoint" if known[k] else "image"
        problem = (
            f"no keypoint {keypoint[k]} in image {seen_ids[k]}" if known[k] else f"no {what} {seen_ids[k]}"
        )
        raise FileFormatError(path, f"point {point}: there is {problem}")
    error_px = np.where(table.error[order] >= 0, table.error[order], np.nan)
    return (
        Points(table.xyz[order], table.rgb[order], error_px),
        Tracks(offsets, image.astype(np.int32), keypoint.astype(np.int32)),
    )
