"""Writing columns to COLMAP's database."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping

import numpy as np

from epipole._checks import require_same_length
from epipole.errors import ConfigError, ShapeError
from epipole.io.colmap._database_tables import (
    CONFIG_OF_KIND,
    HALF_SHIFT,
    MAX_IMAGES,
    SIFT_DESCRIPTOR,
    WGS84,
    DatabaseContents,
    blob,
)
from epipole.io.colmap._tables import CAMERA_SENSOR
from epipole.io.colmap.cameras import HALF_PIXEL, params_to_colmap
from epipole.io.colmap.model import camera_ids_of_sensors, check_image_names, pose_numbers
from epipole.robust.pairs.kind import PairKind
from epipole.scene import Images, ViewGraph


def check_contents(contents: DatabaseContents) -> None:
    """Check that the columns are consistent.

    Raises:
        ConfigError: an image's name is empty, used twice or cannot be written.
        ShapeError: matches, descriptors or GPS do not fit the images, or a pair is given twice.
    """
    images = contents.images
    check_image_names(images.name)
    if len(set(images.name)) < len(images):
        raise ConfigError("two images have the same name")
    num_keypoints = np.diff(images.keypoint_offsets)
    if contents.gps_lat_lon_alt is not None:
        require_same_length(images=images.frame, gps_lat_lon_alt=contents.gps_lat_lon_alt)
    if contents.descriptors is not None:
        if len(contents.descriptors) != len(images):
            raise ShapeError(f"{len(images)} images have {len(contents.descriptors)} arrays of descriptors")
        for name, number, rows in zip(images.name, num_keypoints, contents.descriptors):
            if rows is not None and (rows.ndim != 2 or len(rows) != number or rows.dtype != np.uint8):
                raise ShapeError(
                    f"descriptors of {name} must be ({number}, d) uint8, got {rows.shape} {rows.dtype}"
                )
    _check_pairs(contents.matches, num_keypoints)
    if contents.view_graph is not None:
        verified = dict(_inlier_matches(contents.view_graph))
        if len(verified) < len(contents.view_graph):
            raise ShapeError("the view graph contains a pair twice")
        _check_pairs(verified, num_keypoints)


def _check_pairs(matches: Mapping[tuple[int, int], np.ndarray], num_keypoints: np.ndarray) -> None:
    seen = set()
    for (image1, image2), rows in matches.items():
        if image1 == image2 or not (0 <= image1 < len(num_keypoints) and 0 <= image2 < len(num_keypoints)):
            raise ShapeError(f"({image1}, {image2}) is not a pair of images")
        if (min(image1, image2), max(image1, image2)) in seen:
            raise ShapeError(f"the pair ({image1}, {image2}) is given in both directions")
        seen.add((min(image1, image2), max(image1, image2)))
        if rows.ndim != 2 or rows.shape[1] != 2:
            raise ShapeError(f"matches of ({image1}, {image2}) must be (m, 2), got {rows.shape}")
        limits = num_keypoints[[image1, image2]]
        if len(rows) and (rows.min() < 0 or (rows.max(axis=0) >= limits).any()):
            raise ShapeError(f"matches of ({image1}, {image2}) refer to missing keypoints")


def _inlier_matches(graph: ViewGraph) -> Iterator[tuple[tuple[int, int], np.ndarray]]:
    for pair in range(len(graph)):
        rows = slice(int(graph.match_offsets[pair]), int(graph.match_offsets[pair + 1]))
        matches = np.stack([graph.keypoint1[rows], graph.keypoint2[rows]], axis=1)
        yield (int(graph.image1[pair]), int(graph.image2[pair])), matches


def insert_contents(connection: sqlite3.Connection, contents: DatabaseContents) -> None:
    """Fill the empty tables."""
    camera_ids = camera_ids_of_sensors(contents.rigs, len(contents.cameras))
    _insert(connection, "cameras", 6, _camera_rows(contents, camera_ids))
    _insert_rigs(connection, contents, camera_ids)
    _insert_images(connection, contents, camera_ids)
    _insert(connection, "keypoints", 4, _keypoint_rows(contents.images))
    if contents.descriptors is not None:
        given = ((i + 1, rows) for i, rows in enumerate(contents.descriptors) if rows is not None)
        rows = ((i, SIFT_DESCRIPTOR, *values.shape, blob(values, np.uint8)) for i, values in given)
        _insert(connection, "descriptors", 5, rows)
    matches = sorted(_match_row(pair, rows) for pair, rows in contents.matches.items())
    _insert(connection, "matches", 4, iter(matches))
    if contents.view_graph is not None:
        _insert(connection, "two_view_geometries", 12, _pair_rows(contents.view_graph))


def _insert(connection: sqlite3.Connection, table: str, num_columns: int, rows: Iterator[tuple]) -> None:
    marks = ", ".join("?" * num_columns)
    connection.executemany(f"INSERT INTO {table} VALUES ({marks})", rows)


def _camera_rows(contents: DatabaseContents, camera_ids: list[int]) -> Iterator[tuple]:
    cameras = contents.cameras
    rows = {row + 1: row for row in range(len(cameras))}
    rows |= dict(zip(camera_ids, contents.rigs.sensor_camera.tolist()))
    for camera_id, row in sorted(rows.items()):
        camera = cameras[row]
        params = blob(params_to_colmap(camera.model, camera.params), "<f8")
        trusted = int(cameras.is_focal_trusted[row])
        yield camera_id, int(camera.model), camera.width, camera.height, params, trusted


def _insert_rigs(connection: sqlite3.Connection, contents: DatabaseContents, camera_ids: list[int]) -> None:
    rigs = contents.rigs
    poses = pose_numbers(rigs.cam_from_rig)
    has_sensor = np.diff(rigs.sensor_offsets) > 0
    first = dict(zip(rigs.sensor_offsets[:-1][has_sensor].tolist(), np.flatnonzero(has_sensor).tolist()))
    references = ((rig + 1, camera_ids[sensor], CAMERA_SENSOR) for sensor, rig in first.items())
    _insert(connection, "rigs", 3, references)
    others = (
        (rig + 1, camera_ids[sensor], CAMERA_SENSOR, blob(poses[sensor], "<f8"))
        for sensor, rig in enumerate(rigs.rig_of_sensor().tolist())
        if sensor not in first
    )
    _insert(connection, "rig_sensors", 4, others)


def _insert_images(connection: sqlite3.Connection, contents: DatabaseContents, camera_ids: list[int]) -> None:
    images = contents.images
    camera_of_image = [camera_ids[sensor] for sensor in images.sensor.tolist()]
    frames = ((frame + 1, rig + 1) for frame, rig in enumerate(contents.frames.rig.tolist()))
    _insert(connection, "frames", 2, frames)
    names = ((i + 1, name, camera_of_image[i]) for i, name in enumerate(images.name))
    _insert(connection, "images", 3, names)
    data = ((f + 1, i + 1, camera_of_image[i], CAMERA_SENSOR) for i, f in enumerate(images.frame.tolist()))
    _insert(connection, "frame_data", 4, data)
    if contents.gps_lat_lon_alt is None:
        return
    unknown = (np.full(9, np.nan).tobytes(), np.full(3, np.nan).tobytes())  # covariance, gravity
    known = np.flatnonzero(np.isfinite(contents.gps_lat_lon_alt).all(axis=1)).tolist()
    priors = (
        (
            n,
            i + 1,
            camera_of_image[i],
            CAMERA_SENSOR,
            blob(contents.gps_lat_lon_alt[i], "<f8"),
            *unknown,
            WGS84,
        )
        for n, i in enumerate(known, 1)
    )
    _insert(connection, "pose_priors", 8, priors)


def _keypoint_rows(images: Images) -> Iterator[tuple]:
    for image in range(len(images)):
        keypoints = images.keypoints_of(image) + HALF_PIXEL
        yield image + 1, len(keypoints), 2, keypoints.astype("<f4").tobytes()


def _pair_id(image1: int, image2: int) -> int:
    return MAX_IMAGES * (min(image1, image2) + 1) + max(image1, image2) + 1


def _match_row(pair: tuple[int, int], matches: np.ndarray) -> tuple:
    """A row of a pair, ordered from the smaller to the larger id."""
    image1, image2 = pair
    ordered = matches if image1 < image2 else matches[:, ::-1]
    return _pair_id(image1, image2), len(matches), 2, blob(ordered, "<u4")


def _pair_rows(graph: ViewGraph) -> Iterator[tuple]:
    to_pixel = np.linalg.inv(HALF_SHIFT)
    quat_and_translation = pose_numbers(graph.cam2_from_cam1)
    reverse = pose_numbers(graph.cam2_from_cam1.inverse())
    for e, (pair, matches) in enumerate(_inlier_matches(graph)):
        E, F, H = graph.essential[e], graph.fundamental[e], graph.homography[e]
        F, H = to_pixel.T @ F @ to_pixel, HALF_SHIFT @ H @ to_pixel
        pose = quat_and_translation[e]
        if pair[0] > pair[1]:
            E, F, H, pose = E.T, F.T, _inverse(H), reverse[e]
        config = CONFIG_OF_KIND[PairKind(int(graph.kind[e]))]
        has_pose = bool(np.isfinite(pose).all())
        blobs = (blob(matrix, "<f8") for matrix in (F, E, H))
        pose_blobs = (blob(pose[:4], "<f8"), blob(pose[4:], "<f8")) if has_pose else (None, None)
        yield *_match_row(pair, matches), config, *blobs, *pose_blobs, None, None


def _inverse(homography: np.ndarray) -> np.ndarray:
    if not np.isfinite(homography).all() or np.linalg.matrix_rank(homography) < 3:
        return np.full((3, 3), np.nan)
    return np.linalg.inv(homography)
