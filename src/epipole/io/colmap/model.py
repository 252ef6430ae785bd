"""COLMAP's sparse models, binary and text, with rigs and frames (COLMAP 4) or without (older versions).

The half-pixel offset between COLMAP and epipole is added and removed here: (0.5, 0.5) in a file is (0, 0) in memory.
Ids in a written file are row + 1.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import count, pairwise
from pathlib import Path

import numpy as np

from epipole._checks import checked
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.io.atomic import atomic_folder
from epipole.io.colmap._rows import reconstruction_of
from epipole.io.colmap._tables import (
    CAMERA_SENSOR,
    FILE_NAMES,
    NO_POINT,
    CameraRecord,
    ColmapTables,
    DataRecord,
    FrameRecord,
    ImageRecord,
    PointTable,
    RigRecord,
    SensorRecord,
)
from epipole.io.colmap._text import read_text, write_text
from epipole.io.colmap.binary import read_binary, write_binary
from epipole.io.colmap.cameras import HALF_PIXEL
from epipole.io.colmap.cameras import params_from_colmap as params_from_colmap
from epipole.io.colmap.cameras import params_to_colmap as params_to_colmap
from epipole.io.contents_in_words import results_of, with_what_it_is
from epipole.io.files import missing_in_words
from epipole.io.georeference import GEOREFERENCE, read_georeference, write_georeference
from epipole.io.images.formats import FORMAT_OF_SUFFIX
from epipole.scene import Reconstruction, Rigs


@checked
def write_colmap_model(reconstruction: Reconstruction, folder: str | Path, *, text: bool = False) -> None:
    """Write the registered images and the points as a COLMAP model; the output is deterministic.

    A camera shared by several sensors is written once per sensor, as COLMAP requires. Model files of the other kind
    (text or binary) in the folder are removed; other files stay. The position on Earth, which COLMAP's files cannot
    store, is written to georeference.json.

    Raises:
        ConfigError: an image's name cannot be written to such a file.
        WorkspaceError: the folder cannot be written.
    """
    tables = _tables_of(reconstruction)
    for image in tables.images if text else ():
        if image.name != image.name.strip():
            raise ConfigError(
                f"the image name {image.name!r} cannot be written as text because it would lose its spaces"
            )
    names = [f"{name}.{suffix}" for name in FILE_NAMES for suffix in ("bin", "txt")]
    with atomic_folder(folder, stale=[*names, GEOREFERENCE]) as part:
        (write_text if text else write_binary)(tables, part)
        if reconstruction.georeference is not None:
            write_georeference(part / GEOREFERENCE, reconstruction.georeference)


@checked
def read_colmap_model(folder: str | Path) -> Reconstruction:
    """Read a COLMAP model, binary if there is one, otherwise text; and its georeference.json if there is one.

    Rows are in the order of the file's ids.

    Raises:
        FileFormatError: there is no model, or a file is truncated or inconsistent with another.
    """
    folder = Path(folder)
    georeference = None
    if (folder / GEOREFERENCE).is_file():
        georeference = read_georeference(folder / GEOREFERENCE)
    if (folder / "cameras.bin").is_file():
        model = reconstruction_of(read_binary(folder), folder, "bin")
        return replace(model, georeference=georeference)
    if (folder / "cameras.txt").is_file():
        model = reconstruction_of(read_text(folder), folder, "txt")
        return replace(model, georeference=georeference)
    raise FileFormatError(
        folder,
        "no COLMAP model here (neither cameras.bin nor cameras.txt); pass the folder with these files, such as OUT/sparse/0",
    )


@checked
def camera_ids_of_sensors(rigs: Rigs, num_cameras: int) -> list[int]:
    """COLMAP's camera id of each sensor: the camera's row + 1, or a new id if the camera is already used."""
    new_ids = count(num_cameras + 1)
    used: set[int] = set()
    ids = []
    for camera in rigs.sensor_camera.tolist():
        ids.append(next(new_ids) if camera in used else camera + 1)
        used.add(camera)
    return ids


@checked
def check_image_names(names: Iterable[str]) -> None:
    """Reject names that would corrupt a file.

    Raises:
        ConfigError: a name is empty, contains a line break or a null character, or is not valid UTF-8.
    """
    for name in names:
        is_text = name.encode(errors="replace").decode() == name
        if not (name and is_text) or any(c in name for c in "\0\r\n"):
            raise ConfigError(f"the image name {name!r} cannot be written to a COLMAP file")


def _tables_of(reconstruction: Reconstruction) -> ColmapTables:
    check_image_names(reconstruction.images.name)
    camera_ids = camera_ids_of_sensors(reconstruction.rigs, len(reconstruction.cameras))
    cams_from_world = reconstruction.cams_from_world()
    is_written = np.isfinite(cams_from_world.translation).all(axis=1)
    return ColmapTables(
        cameras=_camera_records(reconstruction, camera_ids),
        rigs=_rig_records(reconstruction.rigs, camera_ids),
        frames=_frame_records(reconstruction, camera_ids, is_written),
        images=_image_records(reconstruction, camera_ids, is_written, cams_from_world),
        points=_point_columns(reconstruction, is_written),
    )


def _camera_records(reconstruction: Reconstruction, camera_ids: list[int]) -> list[CameraRecord]:
    rows = {row + 1: row for row in range(len(reconstruction.cameras))}
    rows |= dict(zip(camera_ids, reconstruction.rigs.sensor_camera.tolist()))
    records = []
    for camera_id, row in sorted(rows.items()):
        camera = reconstruction.cameras[row]
        params = params_to_colmap(camera.model, camera.params)
        records.append(CameraRecord(camera_id, int(camera.model), camera.width, camera.height, params))
    return records


@checked
def pose_numbers(target_from_source: Rigid3) -> np.ndarray:
    """Rows (w, x, y, z, tx, ty, tz); NaN for unknown motions."""
    known = np.isfinite(target_from_source.translation).all(axis=1)
    quat_wxyz = np.full((len(known), 4), np.nan)
    quat_wxyz[known] = Rotation3(target_from_source.rotation[known]).as_quat_wxyz()
    return np.concatenate([quat_wxyz, target_from_source.translation], axis=1)


def _rig_records(rigs: Rigs, camera_ids: list[int]) -> list[RigRecord]:
    poses = pose_numbers(rigs.cam_from_rig)
    records = []
    for rig, (start, stop) in enumerate(pairwise(rigs.sensor_offsets.tolist())):
        sensors = (SensorRecord(CAMERA_SENSOR, camera_ids[s], poses[s]) for s in range(start, stop))
        records.append(RigRecord(rig + 1, tuple(sensors)))
    return records


def _frame_records(
    reconstruction: Reconstruction, camera_ids: list[int], is_written: np.ndarray
) -> list[FrameRecord]:
    images, frames = reconstruction.images, reconstruction.frames
    data: dict[int, list[DataRecord]] = {}
    for image in np.flatnonzero(is_written).tolist():
        record = DataRecord(CAMERA_SENSOR, camera_ids[int(images.sensor[image])], image + 1)
        data.setdefault(int(images.frame[image]), []).append(record)
    poses = pose_numbers(frames.rig_from_world)
    return [
        FrameRecord(frame + 1, int(frames.rig[frame]) + 1, poses[frame], tuple(data[frame]))
        for frame in sorted(data)
    ]


def _image_records(
    reconstruction: Reconstruction, camera_ids: list[int], is_written: np.ndarray, cams_from_world: Rigid3
) -> list[ImageRecord]:
    images, poses = reconstruction.images, pose_numbers(cams_from_world)
    point_of_keypoint = reconstruction.point_of_keypoint().astype(np.int64)
    point_ids = np.where(point_of_keypoint < 0, NO_POINT, point_of_keypoint + 1)
    records = []
    for i in np.flatnonzero(is_written).tolist():
        rows = slice(int(images.keypoint_offsets[i]), int(images.keypoint_offsets[i + 1]))
        camera_id, keypoints = camera_ids[int(images.sensor[i])], images.keypoints_px[rows] + HALF_PIXEL
        records.append(ImageRecord(i + 1, poses[i], camera_id, images.name[i], keypoints, point_ids[rows]))
    return records


def _point_columns(reconstruction: Reconstruction, is_written: np.ndarray) -> PointTable:
    points, tracks = reconstruction.points, reconstruction.tracks
    seen = is_written[tracks.image]
    lengths = np.bincount(tracks.point_of_observation()[seen], minlength=len(tracks))
    return PointTable(
        ids=np.arange(1, len(points) + 1, dtype=np.int64),
        xyz=points.xyz_in_world,
        rgb=points.rgb,
        error=np.where(np.isfinite(points.error_px), points.error_px, -1.0),
        track_offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        track_image_ids=tracks.image[seen].astype(np.int64) + 1,
        track_keypoints=tracks.keypoint[seen].astype(np.int64),
    )


@checked
def find_model(path: str | Path) -> Path:
    """The folder of the COLMAP model inside an output folder, or the folder itself if it is one.

    Raises:
        FileFormatError: there is no model.
    """
    path = Path(path)
    for folder in (path, path / "sparse" / "0", path / "sparse"):
        if (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file():
            return folder
    if not path.exists():
        raise FileFormatError(path, missing_in_words(path))
    images = any(p.suffix.lower() in FORMAT_OF_SUFFIX for at in (path, path / "images") for p in at.glob("*"))
    advice = "`epipole reconstruct` makes a model from images" if images and not results_of(path) else ""
    problem = "it contains no model (no cameras.bin or cameras.txt, nor sparse/0)"
    raise FileFormatError(path, with_what_it_is(problem, path, advice))
