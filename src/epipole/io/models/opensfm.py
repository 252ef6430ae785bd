"""OpenSfM's reconstruction.json with tracks.csv, which OpenDroneMap and Mapillary write, too.

Poses are cam_from_world as rotation vector and translation. Positions in images are relative to the image center and
divided by the longer side of the image, which is where the half pixel between corner and center of a pixel cancels out.
A rig's pose is rig_from_world, and that of its cameras cam_from_rig. With `reference_lla`, world coordinates are meters
east, north and up of that position.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from epipole._checks import checked
from epipole.cameras import Camera
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.io.atomic import atomic_write
from epipole.io.files import problem_of_name, read_json
from epipole.io.json_files import json_text
from epipole.io.models._opensfm_cameras import camera_from_opensfm, opensfm_camera
from epipole.io.models._opensfm_rigs import rig_content, rigs_and_frames
from epipole.io.models._opensfm_tracks import opensfm_observations, track_lines
from epipole.io.models._opensfm_values import motion_of, number_in, table_in
from epipole.io.models.model_file import ModelFile, Observations, no_tracks, with_observations
from epipole.scene import Cameras, Georeference, Images, Points, Reconstruction

RECONSTRUCTION, TRACKS = "reconstruction.json", "tracks.csv"
"""Names of the files in a dataset."""

_REFERENCE = "reference_lla"
_KNOWN_KEYS = frozenset(
    f"cameras shots points {_REFERENCE} rig_cameras rig_instances rig_models biases pano_shots".split()
)
# Measurements and bookkeeping of OpenSfM, which do not affect poses.
_KNOWN_KEYS_OF_IMAGES = frozenset(
    [
        "rotation",
        "translation",
        "camera",
        "orientation",
        "capture_time",
        "gps_dop",
        "gps_position",
        "gravity_down",
        "compass",
        "skey",
        "vertices",
        "faces",
        "scale",
        "covariance",
        "merge_cc",
        "is_interior",
    ]
)
_GRAY = 128


@checked
def write_opensfm(reconstruction: Reconstruction, path: str | Path) -> None:
    """Write the registered images, their cameras and the points, with `tracks.csv` beside the file.

    Keypoints without a point are not written. Cameras are `perspective` or `fisheye` if these suffice, else `brown` or
    `fisheye_opencv`.

    Args:
        reconstruction: the model to write.
        path: the JSON file.

    Raises:
        ConfigError: OpenSfM has no such camera model, or an image's name cannot be written.
        WorkspaceError: a file cannot be written.
    """
    path, model = Path(path), reconstruction
    is_written = model.is_registered()
    content: dict[str, Any] = {"cameras": {}, "shots": {}, "points": {}}
    cams_from_world, camera_of_image = model.cams_from_world(), model.camera_of_image
    vectors = Rotation3(cams_from_world.or_identity().rotation).log()
    for image in np.flatnonzero(is_written).tolist():
        camera = int(camera_of_image[image])
        if f"camera {camera}" not in content["cameras"]:
            content["cameras"][f"camera {camera}"] = opensfm_camera(model.cameras[camera])
        time_s = float(model.frames.timestamp_s[model.images.frame[image]])
        content["shots"][model.images.name[image]] = {
            "rotation": vectors[image].tolist(),
            "translation": cams_from_world.translation[image].tolist(),
            "camera": f"camera {camera}",
            **({"capture_time": time_s} if np.isfinite(time_s) else {}),
        }
    for row, (xyz, rgb) in enumerate(zip(model.points.xyz_in_world.tolist(), model.points.rgb.tolist())):
        content["points"][str(row)] = {"color": [float(value) for value in rgb], "coordinates": xyz}
    content |= rig_content(model, is_written)
    if (origin := model.georeference) is not None:
        content[_REFERENCE] = {
            "latitude": origin.lat_deg,
            "longitude": origin.lon_deg,
            "altitude": origin.alt_m,
        }
    lines = list(track_lines(model, is_written))
    with atomic_write(path) as part:
        part.write_text(json_text([content]), encoding="utf-8")
    with atomic_write(path.with_name(TRACKS)) as part:
        part.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8", newline="\n")


@checked
def read_opensfm(path: str | Path) -> Reconstruction:
    """Read the largest reconstruction of a file, and the keypoints in the `tracks.csv` beside it, if there is one.

    Issues a Python warning for everything in `ModelFile.warnings`.

    Args:
        path: the JSON file.

    Raises:
        FileFormatError: not such a file, a value is invalid, or a projection type or coefficient is not supported.
    """
    return opensfm_contents(path).warned()


@checked
def opensfm_contents(path: str | Path) -> ModelFile:
    """Read the largest reconstruction of a file, and warnings about the rest of it.

    Args:
        path: as in `read_opensfm`.

    Raises:
        FileFormatError: as in `read_opensfm`.
    """
    path = Path(path)
    found = read_json(path)
    if not isinstance(found, list) or not all(isinstance(each, dict) for each in found):
        raise FileFormatError(path, "not a list of reconstructions, so this is not a file of OpenSfM")
    for number, each in enumerate(found):
        if not all(isinstance(each.get(key), dict) for key in ("cameras", "shots")):
            raise FileFormatError(path, f"reconstruction {number} has no cameras and shots")
    if not any(each["shots"] for each in found):
        raise FileFormatError(path, "it has no reconstruction with images")
    try:
        content = max(found, key=lambda each: (len(each["shots"]), len(table_in(each, "points"))))
        return ModelFile(path, _reconstruction(path, content), tuple(_warnings(found, content)))
    except ConfigError as error:
        raise FileFormatError(path, str(error)) from error


def _warnings(found: list[dict[str, Any]], content: dict[str, Any]) -> list[str]:
    out = []
    num_images = len(content["shots"])
    if len(found) > 1:
        most = f"the one with the most images ({num_images})"
        out.append(f"it has {len(found)} disconnected reconstructions; only {most} is read")
    if panoramas := len(table_in(content, "pano_shots")):
        out.append(f"panoramas are not read ({panoramas} in pano_shots)")
    unknown = {key for key in content if key not in _KNOWN_KEYS}
    for values in content["shots"].values():
        unknown |= {f"shots: {key}" for key in values if key not in _KNOWN_KEYS_OF_IMAGES}
    if unknown:
        out.append(f"unknown keys are ignored: {', '.join(sorted(unknown))[:200]}")
    return out


def _reconstruction(path: Path, content: Mapping[str, Any]) -> Reconstruction:
    names, values = list(content["shots"]), list(content["shots"].values())
    cameras, rows = _cameras(content["cameras"], names, values)
    poses = Rigid3.stack([motion_of(each, f"image {name[:80]!r}") for name, each in zip(names, values)])
    points, row_of_point = _points(table_in(content, "points"))
    rig = rigs_and_frames(content, names, rows, poses, _times(values))
    no_keypoints = np.zeros(len(names) + 1, np.int64)
    images = Images(tuple(names), rig.frame, rig.sensor, no_keypoints, np.empty((0, 2)))
    tracks = no_tracks(len(points))
    columns = Cameras.from_list(cameras)
    model = Reconstruction(columns, rig.rigs, rig.frames, images, points, tracks, _georeference(content))
    file = path.with_name(TRACKS)
    if not file.exists():
        return with_observations(model, Observations.none())
    sizes = np.stack([columns.width, columns.height], axis=1)[rows].astype(np.float64)
    return with_observations(model, opensfm_observations(file, names, sizes, row_of_point))


def _cameras(
    content: Mapping[str, Any], names: list[str], values: list[Any]
) -> tuple[list[Camera], np.ndarray]:
    """The cameras, and the row of the camera of each image."""
    cameras = []
    for key, entry in content.items():
        if not isinstance(entry, dict):
            raise ConfigError(f"camera {key[:60]!r} is not an object")
        try:
            cameras.append(camera_from_opensfm(entry))
        except ConfigError as error:
            raise ConfigError(f"camera {key[:60]!r}: {error}") from error
    row_of_camera = {key: row for row, key in enumerate(content)}
    rows = []
    for name, image in zip(names, values):
        if (problem := problem_of_name(name)) is not None:
            raise ConfigError(problem)
        camera = image.get("camera") if isinstance(image, dict) else None
        if not isinstance(camera, str) or camera not in row_of_camera:
            raise ConfigError(
                f"image {name[:80]!r} has the camera {str(camera)[:60]!r}, which does not exist"
            )
        rows.append(row_of_camera[camera])
    return cameras, np.array(rows, np.int32)


def _times(values: list[Any]) -> np.ndarray:
    """Seconds; OpenSfM writes 0 if the time is unknown."""
    times = [number_in(image, "capture_time", 0.0) for image in values]
    return np.array([time_s if time_s else np.nan for time_s in times])


def _points(content: Mapping[str, Any]) -> tuple[Points, dict[str, int]]:
    """The points, and the row of each by its name."""
    try:
        xyz = np.array([point["coordinates"] for point in content.values()], np.float64)
        gray = [_GRAY] * 3
        rgb = np.array([point.get("color", gray) for point in content.values()], np.float64)
    except (KeyError, AttributeError, TypeError, ValueError, OverflowError) as error:
        raise ConfigError("a point does not have three coordinates and a color") from error
    if not len(content):
        xyz, rgb = np.empty((0, 3)), np.empty((0, 3))
    if xyz.shape != (len(content), 3) or rgb.shape != xyz.shape:
        raise ConfigError("a point does not have three coordinates and a color")
    if not (np.isfinite(xyz).all() and ((rgb >= 0) & (rgb <= 255)).all()):
        raise ConfigError("a point has coordinates that are not finite, or a color outside 0 to 255")
    row_of_point = {key: row for row, key in enumerate(content)}
    return Points(xyz, np.rint(rgb).astype(np.uint8), np.full(len(xyz), np.nan)), row_of_point


def _georeference(content: Mapping[str, Any]) -> Georeference | None:
    """The origin of the coordinates; None without one, or at zero, which OpenSfM writes if positions are unknown."""
    values = content.get(_REFERENCE)
    if values is None:
        return None
    if not isinstance(values, dict):
        raise ConfigError(f"{_REFERENCE} is not an object")
    lat_deg, lon_deg, alt_m = (number_in(values, key) for key in ("latitude", "longitude", "altitude"))
    return Georeference(lat_deg, lon_deg, alt_m) if lat_deg or lon_deg or alt_m else None
