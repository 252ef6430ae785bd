"""RealityScan's (formerly RealityCapture's) camera parameters as CSV (Export > Registration).

    cam_from_world = diag(1, -1, -1) R_y(-roll) R_x(-pitch) R_z(heading)

x, y and alt are the position of the camera, z up. With angles of zero, the camera looks down and the top of its image
points along +y (north); the heading is clockwise. f is the focal length in millimeters on a frame whose longer side is 36 mm.
px and py are the offset of the principal point from the image center, to the right and down, divided by the longer side of the
image in pixels. The distortion is Brown's, where t1 belongs to r^2 + 2 x^2, so it is OpenCV's p2. (M. Hornacek, On the
Coordinate Systems Employed in the Import, Estimation, and Export of Camera Geometry by RealityScan, Epic Games 2026, sections
3 to 5 and appendix A.)

The file has neither image sizes nor the name of its coordinate system or distortion model.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole._checks import checked
from epipole.cameras import Camera
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3
from epipole.geometry.euler_angles import euler_angles_of_rotation, rotation_of_euler_angles
from epipole.io.atomic import atomic_write
from epipole.io.files import file_text, problem_of_name
from epipole.io.images.photographs import PhotographHeader, read_header
from epipole.io.models._brown import brown_coefficients, brown_model, one_focal_px
from epipole.io.models.model_file import (
    ModelFile,
    Observations,
    distinct_cameras,
    model_of_single_images,
    no_points,
)
from epipole.io.names import path_inside
from epipole.scene import Reconstruction

CAMERAS_CSV = "cameras.csv"
"""Name of the file that `epipole convert` writes."""
IMAGE_FOLDER = "images"
"""Folder beside the file in which images are searched."""
HEADER = "#name,"
"""Start of the line with the names of the columns."""

_AXES = "zxy"
_POSE = ("name", "x", "y", "alt", "heading", "pitch", "roll")
_INTRINSICS, _DISTORTION = ("f", "px", "py"), ("k1", "k2", "k3", "k4", "t1", "t2")
_SAME_COLUMNS = {"z": "alt", "yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py"}
"""Other names of columns: RealityScan 2 has yaw, f_35mm, px_norm and py_norm, and the export without intrinsics has z."""
_COUNT = "#cameras"
"""Start of an optional first line with the number of cameras."""
_FRAME_MM = 36.0
_CENTER_OF_FIRST_PIXEL = 0.5
_FLIP = np.array([1.0, -1.0, -1.0])
"""From OpenGL's axes of a camera to OpenCV's."""
_MOST_BYTES = 1 << 28
_FARTHEST = 1e12
_MOST_DEGREES = np.array([180.0, 90.0])
_PROJECTED_M = 1e5
"""Magnitude of x or y above which they are probably coordinates of a map projection."""
_SMALL_SPREAD = 0.01
"""Spread of x and y relative to their magnitude below which values in the range of degrees are probably degrees."""


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """The columns of a file."""

    names: list[str]
    values: dict[str, np.ndarray]
    """(n,) numbers by the name of their column."""
    warnings: list[str]


@checked
def write_realityscan(reconstruction: Reconstruction, path: str | Path) -> None:
    """Write the registered images, with one line each; the format has no points, tracks, rigs and image sizes.

    The columns are those of RealityCapture, which nerfstudio, Postshot and Brush read, too.

    Args:
        reconstruction: the model to write. Its coordinates are not changed.
        path: the CSV file.

    Raises:
        ConfigError: the format cannot represent a camera (undistort the images first), or an image's name.
        WorkspaceError: the file cannot be written.
    """
    model = reconstruction
    registered = np.flatnonzero(model.is_registered()).tolist()
    worlds_from_cams = model.cams_from_world()[registered].inverse()
    angles_rad = euler_angles_of_rotation(_AXES, worlds_from_cams.rotation * _FLIP)
    angles_deg = np.rad2deg(angles_rad) * [-1.0, 1.0, 1.0]
    intrinsics = [_intrinsics_of(camera) for camera in _cameras_of(model, registered)]
    lines = [f"#{','.join((*_POSE, *_INTRINSICS, *_DISTORTION))}"]
    for row, image in enumerate(registered):
        numbers = [*worlds_from_cams.translation[row].tolist(), *angles_deg[row].tolist(), *intrinsics[row]]
        lines.append(",".join([_written_name(model.images.name[image]), *map(repr, numbers)]))
    with atomic_write(Path(path)) as part:
        part.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8", newline="\n")


def _cameras_of(model: Reconstruction, images: Sequence[int]) -> list[Camera]:
    return [model.cameras[int(model.camera_of_image[image])] for image in images]


def _written_name(name: str) -> str:
    if "," in name or '"' in name or name.startswith("#") or name != name.strip():
        raise ConfigError(
            f"the image name {name!a} cannot be written to a CSV file of RealityScan: rename the image,"
            " without commas, quotes, spaces at its ends and a # at its start"
        )
    return name


def _intrinsics_of(camera: Camera) -> list[float]:
    """f, px, py and the coefficients of the distortion."""
    k = brown_coefficients(camera, "RealityScan")
    side = max(camera.width, camera.height)
    offset = camera.K[:2, 2] + _CENTER_OF_FIRST_PIXEL - 0.5 * np.array([camera.width, camera.height])
    focal = one_focal_px(camera, "RealityScan") * _FRAME_MM / side
    return [focal, *(offset / side).tolist(), k["k1"], k["k2"], k["k3"], 0.0, k["p1"], k["p2"]]


@checked
def read_realityscan(path: str | Path) -> Reconstruction:
    """Read the cameras of a file; the format has no points and no tracks.

    The images must be beside the file or in `images/`, since the file has no image sizes. A file without intrinsics (name,
    position and angles) gets the focal lengths of the images' EXIF data. Coordinates are those of the file. Issues a
    Python warning for everything in `ModelFile.warnings`.

    Args:
        path: the CSV file.

    Raises:
        FileFormatError: not such a file, a column is unknown, a value is invalid or not supported, or an image is missing.
    """
    return realityscan_contents(path).warned()


@checked
def realityscan_contents(path: str | Path) -> ModelFile:
    """Read the cameras of a file, and warnings about what it leaves open.

    Args:
        path: as in `read_realityscan`.

    Raises:
        FileFormatError: as in `read_realityscan`.
    """
    path = Path(path)
    table = _table_of(path)
    headers = [_header_of(path, name) for name in table.names]
    try:
        each = [_camera_of(table, row, header) for row, header in enumerate(headers)]
    except ConfigError as error:
        raise FileFormatError(path, str(error)) from error
    cameras, camera_rows = distinct_cameras(each)
    angles_rad = np.deg2rad(np.stack([table.values[key] for key in _POSE[4:]], axis=1)) * [-1.0, 1.0, 1.0]
    centers = np.stack([table.values[key] for key in _POSE[1:4]], axis=1)
    rotation = rotation_of_euler_angles(_AXES, angles_rad).matrix * _FLIP
    model = model_of_single_images(
        table.names,
        cameras,
        camera_rows,
        Rigid3(rotation, centers).inverse(),
        no_points(),
        Observations.none(),
    )
    return ModelFile(path, model, (*table.warnings, *_warnings_about(table.values, centers)))


def _table_of(path: Path) -> _Table:
    lines = [
        (number, line.strip()) for number, line in enumerate(file_text(path, _MOST_BYTES).splitlines(), 1)
    ]
    lines = [(number, line) for number, line in lines if line and not line.lower().startswith(_COUNT)]
    if not lines or not lines[0][1].lower().startswith(HEADER):
        raise FileFormatError(
            path, f"not cameras of RealityScan (its first line does not start with {HEADER})"
        )
    columns, warnings = _columns_of(path, lines[0][1])
    if len(lines) == 1:
        raise FileFormatError(path, "it has no cameras")
    names, rows = [], np.empty((len(lines) - 1, len(columns) - 1))
    for row, (number, line) in enumerate(lines[1:]):
        words = [word.strip() for word in line.split(",")]
        if len(words) != len(columns):
            raise FileFormatError(path, f"line {number}: {len(columns)} values expected, got {len(words)}")
        name = words[0].replace("\\", "/").removeprefix("./")
        if (problem := problem_of_name(name)) is not None:
            raise FileFormatError(path, f"line {number}: {problem}")
        names.append(name)
        rows[row] = [_number(path, number, key, word) for key, word in zip(columns[1:], words[1:])]
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    if twice is not None:
        raise FileFormatError(path, f"it has two cameras with the name {twice[:80]!r}")
    if np.abs(rows).max() >= _FARTHEST:
        raise FileFormatError(path, "it has a number that is too large")
    return _Table(names, dict(zip(columns[1:], rows.T)), warnings)


def _columns_of(path: Path, line: str) -> tuple[list[str], list[str]]:
    """The names of the columns, as RealityCapture writes them, and warnings about columns that are missing."""
    given = [word.strip().lower() for word in line.removeprefix("#").split(",")]
    columns = [_SAME_COLUMNS.get(word, word) for word in given]
    known = (*_POSE, *_INTRINSICS, *_DISTORTION)
    for word, column in zip(given, columns):
        if column not in known:
            raise FileFormatError(path, f"unknown column {word[:40]!r}; known are {', '.join(known)}")
        if columns.count(column) > 1:
            raise FileFormatError(path, f"two columns are {column}")
    parts = (_POSE, _INTRINSICS, _DISTORTION)
    for part in parts:
        missing = [column for column in part if column not in columns]
        if missing and (part is _POSE or len(missing) < len(part)):
            raise FileFormatError(path, f"it has no column {missing[0]}")
    if "f" not in columns and "k1" in columns:
        raise FileFormatError(path, "it has distortion, but no column f")
    if "f" not in columns:
        return columns, ["it has no intrinsics; focal lengths are those of EXIF, and distortion is unknown"]
    without = "it has no columns of distortion; cameras are read without distortion"
    return columns, [] if "k1" in columns else [without]


def _number(path: Path, line: int, key: str, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise FileFormatError(path, f"line {line}: {key} is not a finite number, got {word[:40]!r}")
    return value


def _header_of(path: Path, name: str) -> PhotographHeader:
    folder = path.parent
    found = next(
        (root for root in (folder, folder / IMAGE_FOLDER) if path_inside(root, name).is_file()), None
    )
    file = path_inside(folder / IMAGE_FOLDER if found is None else found, name)
    try:
        return read_header(file)
    except FileFormatError as error:
        raise FileFormatError(path, f"it has no image sizes, and an image cannot be read: {error}") from error


def _camera_of(table: _Table, row: int, header: PhotographHeader) -> Camera:
    """The camera of an image.

    Raises:
        ConfigError: a value is invalid or not supported, or the focal length is unknown.
    """
    name, value = table.names[row], {key: float(column[row]) for key, column in table.values.items()}
    size = np.array([header.width, header.height])
    side = float(size.max())
    if "f" in value:
        focal_px = value["f"] * side / _FRAME_MM
        offset = side * np.array([value["px"], value["py"]])
    elif header.focal_px is not None:
        focal_px, offset = header.focal_px, np.zeros(2)
    else:
        raise ConfigError(
            f"the focal length of {name[:80]!a} is unknown, as neither the file nor EXIF has it: export the internal/external"
            " camera parameters, with f, px and py"
        )
    k = {key: value.get(key, 0.0) for key in _DISTORTION}
    if k["k4"]:
        raise ConfigError(
            f"k4 = {k['k4']:g} of {name[:80]!a} is not supported: align with Brown3, or export undistorted images"
        )
    model, distortion = brown_model(k["k1"], k["k2"], k["k3"], k["t1"], k["t2"])
    center = 0.5 * size + offset - _CENTER_OF_FIRST_PIXEL
    try:
        return Camera(
            model, header.width, header.height, np.array([focal_px, focal_px, *center, *distortion])
        )
    except ConfigError as error:
        raise ConfigError(f"the camera of {name[:80]!a}: {error}") from error


def _warnings_about(values: dict[str, np.ndarray], centers: np.ndarray) -> list[str]:
    """Warnings about what the file leaves open."""
    out = []
    others = [values[key].any() for key in _DISTORTION[1:] if key in values]
    if "k1" in values and values["k1"].any() and not any(others):
        out.append(
            "only k1 is not zero: it is read as a coefficient of Brown's model; if the distortion model is Division, export again"
            " with Brown3"
        )
    spread, largest = np.ptp(centers[:, :2], axis=0).max(), np.abs(centers[:, :2]).max(axis=0)
    if len(centers) > 1 and (largest <= _MOST_DEGREES).all() and spread < _SMALL_SPREAD * largest.max():
        out.append(
            "x and y may be degrees of longitude and latitude, but are read as lengths; export in a metric coordinate system"
        )
    if largest.max() > _PROJECTED_M:
        out.append(
            "x and y may be coordinates of a map projection, whose north differs from that of the angles by up to some degrees;"
            " export in local coordinates"
        )
    return out
