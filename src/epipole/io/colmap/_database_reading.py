"""Reading COLMAP's database, of any version, into columns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from epipole.geometry import Rigid3, Rotation3
from epipole.io.colmap._database_tables import (
    HALF_SHIFT,
    KIND_OF_CONFIG,
    MAX_IMAGES,
    WGS84,
    DatabaseContents,
    DatabaseReader,
)
from epipole.io.colmap._rows import (
    ImagePoses,
    cameras_of,
    frames_of,
    require_cameras,
    rigs_of,
    rows_of_ids,
    trivial_frames,
)
from epipole.io.colmap._tables import (
    CAMERA_SENSOR,
    IDENTITY_POSE,
    UNKNOWN_POSE,
    CameraRecord,
    DataRecord,
    FrameRecord,
    RigRecord,
    SensorRecord,
)
from epipole.io.colmap.cameras import HALF_PIXEL
from epipole.scene import Cameras, Frames, Images, Rigs, ViewGraph, unregistered

_KEYPOINT_WIDTHS = (2, 4, 6)
"""x, y; optionally with scale and angle, or an affine shape."""


def read_contents(database: DatabaseReader, *, with_pairs: bool) -> DatabaseContents:
    """Read all tables that epipole uses, or only those of cameras and images.

    Raises:
        FileFormatError: a cell is truncated, or an id is missing.
    """
    _require_tables(database)
    cameras, camera_rows = _cameras(database)
    image_rows = database.rows("images", "image_id, name, camera_id", "image_id")
    image_ids, camera_ids = [row[0] for row in image_rows], [row[2] for row in image_rows]
    require_cameras(image_ids, camera_ids, camera_rows, database.path)
    rigs, positions = _rigs_and_poses(database, camera_rows, image_ids, camera_ids)
    images = _images(database, image_ids, tuple(str(row[1]) for row in image_rows), positions)
    matches = _matches(database, image_ids, images) if with_pairs else {}
    return DatabaseContents(
        cameras,
        rigs,
        Frames(
            positions.rig_of_frame,
            unregistered(len(positions.rig_of_frame)),
            np.full(len(positions.rig_of_frame), np.nan),
        ),
        images,
        _descriptors(database, image_ids, images),
        matches,
        _view_graph(database, image_ids, images, matches) if with_pairs else None,
        _gps(database, image_ids),
    )


def matched_pairs(database: DatabaseReader) -> np.ndarray:
    """Rows (i, j) of the images of each pair with matches, sorted.

    Raises:
        FileFormatError: an id is missing.
    """
    _require_tables(database)
    row_of = {row[0]: k for k, row in enumerate(database.rows("images", "image_id", "image_id"))}
    found = database.rows("matches", "pair_id, rows", "pair_id")
    pairs = sorted(_pair(database, pair_id, row_of) for pair_id, count in found if count)
    return np.array(pairs, np.int32).reshape(-1, 2)


def _require_tables(database: DatabaseReader) -> None:
    for table in ("cameras", "images", "keypoints"):
        if not database.columns(table):
            raise database.fail(f"table {table}", "missing: not a COLMAP database")


def _cameras(database: DatabaseReader) -> tuple[Cameras, dict[int, int]]:
    columns = "camera_id, model, width, height, params, prior_focal_length"
    rows, records = database.rows("cameras", columns, "camera_id"), []
    for camera_id, model, width, height, data, _ in rows:
        size = len(data) // 8 if isinstance(data, bytes) else 0
        params = database.matrix(data, "<f8", 1, size, f"camera {camera_id}")[0]
        records.append(CameraRecord(camera_id, model, width, height, params))
    row_of = rows_of_ids([row[0] for row in rows], database.path, "camera")
    trusted = np.array([bool(row[5]) for row in rows], bool)
    return replace(cameras_of(records, database.path), is_focal_trusted=trusted), row_of


def _rigs_and_poses(
    database: DatabaseReader, camera_rows: dict[int, int], image_ids: list[int], camera_ids: list[int]
) -> tuple[Rigs, ImagePoses]:
    frame_rows = database.rows("frames", "frame_id, rig_id", "frame_id")
    if not frame_rows:
        return Rigs.of_single_cameras(len(camera_rows)), trivial_frames(camera_ids, camera_rows)
    sensors: dict[int, list[SensorRecord]] = {}
    for rig_id, sensor_type, sensor_id in database.rows(
        "rigs", "rig_id, ref_sensor_type, ref_sensor_id", "rig_id"
    ):
        sensors[rig_id] = [SensorRecord(sensor_type, sensor_id, IDENTITY_POSE)]
    columns = "rig_id, sensor_type, sensor_id, sensor_from_rig"
    for rig_id, sensor_type, sensor_id, data in database.rows("rig_sensors", columns, "rig_id, sensor_id"):
        if rig_id not in sensors:
            raise database.fail("table rig_sensors", f"rig {rig_id} is not defined")
        pose = database.numbers(data, 7, f"rig {rig_id}")
        sensors[rig_id].append(SensorRecord(sensor_type, sensor_id, pose))
    rigs = [RigRecord(rig_id, tuple(records)) for rig_id, records in sensors.items()]
    layout = rigs_of(rigs, camera_rows, database.path)
    data_of_frame: dict[int, list[DataRecord]] = {}
    columns = "frame_id, sensor_type, sensor_id, data_id"
    for frame_id, *record in database.rows("frame_data", columns, "frame_id, data_id"):
        data_of_frame.setdefault(frame_id, []).append(DataRecord(*record))
    frames = [
        FrameRecord(f, rig_id, UNKNOWN_POSE, tuple(data_of_frame.get(f, ()))) for f, rig_id in frame_rows
    ]
    return layout.rigs, frames_of(frames, layout, image_ids, camera_ids, database.path)


def _images(
    database: DatabaseReader, image_ids: list[int], names: tuple[str, ...], positions: ImagePoses
) -> Images:
    found = {}
    for image_id, rows, cols, data in database.rows("keypoints", "image_id, rows, cols, data", "image_id"):
        position = f"keypoints of image {image_id}"
        values = database.matrix(data, "<f4", rows, cols, position)
        if rows and cols not in _KEYPOINT_WIDTHS:
            raise database.fail(position, f"{cols} columns, expected 2, 4 or 6")
        found[image_id] = values[:, :2].astype(np.float64) if rows else np.empty((0, 2))
    keypoints = [found.get(image_id, np.empty((0, 2))) for image_id in image_ids]
    offsets = np.concatenate([[0], np.cumsum([len(k) for k in keypoints])]).astype(np.int64)
    pixels = np.concatenate([np.empty((0, 2)), *keypoints]) - HALF_PIXEL
    return Images(names, positions.frame_of_image, positions.sensor_of_image, offsets, pixels)


def _descriptors(
    database: DatabaseReader, image_ids: list[int], images: Images
) -> list[np.ndarray | None] | None:
    """Byte descriptors; others (32-bit floats, in newer versions) are skipped."""
    with_type = "type" in database.columns("descriptors")
    columns = f"image_id, rows, cols, data, {'type' if with_type else '0'}"
    number = dict(zip(image_ids, np.diff(images.keypoint_offsets).tolist()))
    found = {}
    for image_id, rows, cols, data, kind in database.rows("descriptors", columns, "image_id"):
        if kind != 0:
            continue
        values = database.matrix(data, np.uint8, rows, cols, f"descriptors of image {image_id}")
        if len(values) != number.get(image_id, len(values)):
            raise database.fail(
                f"descriptors of image {image_id}", "their number differs from the number of keypoints"
            )
        found[image_id] = values
    return [found.get(image_id) for image_id in image_ids] if found else None


def _pair(database: DatabaseReader, pair_id: int, row_of: dict[int, int]) -> tuple[int, int]:
    id1, id2 = divmod(pair_id, MAX_IMAGES)
    if id1 not in row_of or id2 not in row_of or id1 >= id2:
        raise database.fail(f"pair {pair_id}", f"images {id1} and {id2} are not defined")
    return row_of[id1], row_of[id2]


def _match_rows(
    database: DatabaseReader, row: tuple, row_of: dict[int, int], images: Images
) -> tuple[tuple[int, int], np.ndarray]:
    pair_id, rows, cols, data = row
    pair = _pair(database, pair_id, row_of)
    values = database.matrix(data, "<u4", rows, cols, f"pair {pair_id}")
    if rows and cols != 2:
        raise database.fail(f"pair {pair_id}", f"{cols} columns, expected 2")
    matches = values.astype(np.int64) if rows else np.empty((0, 2), np.int64)
    if (matches >= np.diff(images.keypoint_offsets)[list(pair)]).any():
        raise database.fail(f"pair {pair_id}", "a match refers to a missing keypoint")
    return pair, matches.astype(np.int32)


def _matches(
    database: DatabaseReader, image_ids: list[int], images: Images
) -> dict[tuple[int, int], np.ndarray]:
    row_of = {image_id: row for row, image_id in enumerate(image_ids)}
    rows = database.rows("matches", "pair_id, rows, cols, data", "pair_id")
    return dict(_match_rows(database, row, row_of, images) for row in rows)


def _view_graph(
    database: DatabaseReader,
    image_ids: list[int],
    images: Images,
    putative: dict[tuple[int, int], np.ndarray],
) -> ViewGraph | None:
    row_of = {image_id: row for row, image_id in enumerate(image_ids)}
    there = database.columns("two_view_geometries")
    wanted = ["F", "E", "H", "qvec", "tvec"]
    columns = ", ".join(name if name in there else f"NULL AS {name}" for name in wanted)
    rows = database.rows("two_view_geometries", f"pair_id, rows, cols, data, config, {columns}", "pair_id")
    if not rows:
        return None
    pairs, matches, kinds = [], [], []
    models, poses = np.full((len(rows), 3, 3, 3), np.nan), np.full((len(rows), 7), np.nan)
    for e, (*match_row, config, F, E, H, qvec, tvec) in enumerate(rows):
        pair, inliers = _match_rows(database, tuple(match_row), row_of, images)
        position = f"pair {match_row[0]}"
        if config not in KIND_OF_CONFIG:
            raise database.fail(position, f"unknown configuration {config}")
        pairs.append(pair)
        matches.append(inliers)
        kinds.append(int(KIND_OF_CONFIG[config]))
        for m, data in enumerate((F, E, H)):
            models[e, m] = database.numbers(data, 9, position).reshape(3, 3)
        poses[e] = [*database.numbers(qvec, 4, position), *database.numbers(tvec, 3, position)]
    models[~models.any(axis=(2, 3))] = np.nan  # older versions store an unknown matrix as zeros
    to_pixel = np.linalg.inv(HALF_SHIFT)
    flat = np.concatenate(matches)
    image1, image2 = np.array(pairs, np.int32).T.copy()
    num_putative = [len(putative.get(pair, inliers)) for pair, inliers in zip(pairs, matches)]
    return ViewGraph(
        image1=image1,
        image2=image2,
        kind=np.array(kinds, np.int32),
        num_putative=np.array(num_putative, np.int32),
        match_offsets=np.concatenate([[0], np.cumsum([len(m) for m in matches])]).astype(np.int64),
        keypoint1=flat[:, 0].copy(),
        keypoint2=flat[:, 1].copy(),
        cam2_from_cam1=_motions(poses),
        essential=models[:, 1].copy(),
        fundamental=HALF_SHIFT.T @ models[:, 0] @ HALF_SHIFT,
        homography=to_pixel @ models[:, 2] @ HALF_SHIFT,
        median_angle_rad=np.full(len(rows), np.nan),
    )


def _motions(poses: np.ndarray) -> Rigid3:
    """cam2_from_cam1 with |t| = 1; NaN if the quaternion or the translation is zero or unknown."""
    known = np.isfinite(poses).all(axis=1) & poses[:, :4].any(axis=1) & poses[:, 4:].any(axis=1)
    known &= (np.abs(np.nan_to_num(poses)) < 1e100).all(axis=1)
    rotation, translation = np.full((len(poses), 3, 3), np.nan), np.full((len(poses), 3), np.nan)
    rotation[known] = Rotation3.from_quat_wxyz(poses[known, :4]).matrix
    translation[known] = poses[known, 4:] / np.linalg.norm(poses[known, 4:], axis=1, keepdims=True)
    return Rigid3(rotation, translation)


def _gps(database: DatabaseReader, image_ids: list[int]) -> np.ndarray | None:
    """GPS positions (WGS84); priors in other coordinate systems are ignored."""
    there = database.columns("pose_priors")
    if not {"position", "coordinate_system"} <= there:
        return None
    if "corr_data_id" in there:
        columns = "corr_data_id, corr_sensor_type, coordinate_system, position"
    else:
        columns = f"image_id, {CAMERA_SENSOR}, coordinate_system, position"
    row_of = {image_id: row for row, image_id in enumerate(image_ids)}
    out = np.full((len(image_ids), 3), np.nan)
    for image_id, sensor_type, system, data in database.rows("pose_priors", columns, "1"):
        if sensor_type == CAMERA_SENSOR and system == WGS84 and image_id in row_of:
            out[row_of[image_id]] = database.numbers(data, 3, f"GPS of image {image_id}")
    return out if np.isfinite(out).any() else None
