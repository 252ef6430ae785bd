"""Animation of a camera as .chan, which Nuke, Houdini and Blender read: one line of numbers for each frame.

    frame  tx ty tz  rx ry rz  vfov        world_from_cam = R_y(ry) R_x(rx) R_z(rz), in degrees

The rotation order is Nuke's default ZXY: z is rotated first. Camera axes are OpenGL's (y up, looking along -z). vfov is the
vertical field of view, 2 atan(h / (2 f)). The file has neither the image size, the principal point nor a distortion.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from epipole._checks import checked
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3
from epipole.geometry.euler_angles import euler_angles_of_rotation, rotation_of_euler_angles
from epipole.io.atomic import atomic_write
from epipole.io.files import file_text
from epipole.io.images.photographs import list_photographs, read_header
from epipole.io.models._brown import one_focal_px, refuse_distortion
from epipole.io.models.model_file import (
    ModelFile,
    Observations,
    distinct_cameras,
    model_of_single_images,
    no_points,
)
from epipole.scene import Reconstruction

SUFFIX = ".chan"
IMAGE_FOLDER = "images"
"""Folder beside the file in which the images of the frames are searched."""

_AXES, _COLUMNS = "yxz", 8
_FLIP = np.array([1.0, -1.0, -1.0])
"""From OpenGL's axes of a camera to OpenCV's."""
_MOST_BYTES, _FARTHEST, _MOST_FRAMES = 1 << 28, 1e12, 2**31
_NUMBER, _MOST_DIGITS = re.compile("[0-9]+"), 9


@checked
def frame_numbers(names: Sequence[str]) -> list[int]:
    """Frame numbers of images: the last numbers of their names if these differ, else 1, 2, 3 in the order of the names.

    Args:
        names: the images, such as `plate.1001.jpg`.
    """
    found = [_NUMBER.findall(PurePosixPath(name).stem) for name in names]
    numbers = [int(words[-1]) for words in found if words and len(words[-1]) <= _MOST_DIGITS]
    if len(numbers) == len(set(numbers)) == len(names):
        return numbers
    rank = {name: row for row, name in enumerate(sorted(names), 1)}
    return [rank[name] for name in names]


@checked
def write_chan(reconstruction: Reconstruction, path: str | Path) -> None:
    """Write the registered images as frames of one camera, in the coordinates of the model.

    Frames are numbered by `frame_numbers`; images without a pose have no frame. The field of view is that of the vertical
    focal length.

    Args:
        reconstruction: the model to write. Its images have one size, since they are frames of one camera.
        path: the file.

    Raises:
        ConfigError: a camera has distortion (undistort the images first), or there are several cameras.
        WorkspaceError: the file cannot be written.
    """
    model = reconstruction
    numbers = frame_numbers(model.images.name)
    registered = np.flatnonzero(model.is_registered()).tolist()
    registered.sort(key=lambda image: numbers[image])
    cameras = [model.cameras[int(model.camera_of_image[image])] for image in registered]
    _refuse_other_cameras(model, cameras)
    worlds_from_cams = model.cams_from_world()[registered].inverse()
    angles = euler_angles_of_rotation(_AXES, worlds_from_cams.rotation * _FLIP)
    ry, rx, rz = np.rad2deg(np.unwrap(angles, axis=0)).T
    half = [0.5 * camera.height / camera.K[1, 1] for camera in cameras]
    columns = [*worlds_from_cams.translation.T, rx, ry, rz, np.rad2deg(2.0 * np.arctan(half))]
    with atomic_write(Path(path)) as part, part.open("w", encoding="ascii", newline="\n") as stream:
        for image, row in zip(registered, np.stack(columns, axis=1)):
            stream.write(f"{numbers[image]}\t{chr(9).join(map(repr, row.tolist()))}\n")


def _refuse_other_cameras(model: Reconstruction, cameras: Sequence[Camera]) -> None:
    for camera in cameras:
        refuse_distortion(camera, "a .chan file")
        one_focal_px(camera, "a .chan file")
    if (np.diff(model.rigs.sensor_offsets) > 1).any():
        raise ConfigError("a .chan file is the animation of one camera, but the model has a rig of several")
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if len(sizes) > 1:
        few = ", ".join(f"{width} x {height}" for width, height in sizes[:3])
        raise ConfigError(
            f"a .chan file is the animation of one camera, but the images have several sizes ({few})"
        )


@checked
def read_chan(path: str | Path, size: tuple[int, int] | None = None) -> Reconstruction:
    """Read the frames of a camera; the principal point is the image center, and there are no points.

    The images of the frames are those in `images/` beside the file, by the numbers of `frame_numbers`. Issues a Python
    warning for everything in `ModelFile.warnings`.

    Args:
        path: the file.
        size: width and height of the images in pixels; then no images are needed, and their names are the frame numbers.
            None: read from the images.

    Raises:
        FileFormatError: not such a file, a value is invalid, or the image of a frame is missing.
    """
    return chan_contents(path, size).warned()


@checked
def chan_contents(path: str | Path, size: tuple[int, int] | None = None) -> ModelFile:
    """Read the frames of a camera, and a warning about images without a frame.

    Args:
        path: as in `read_chan`.
        size: as in `read_chan`.

    Raises:
        FileFormatError: as in `read_chan`.
    """
    path = Path(path)
    values = _values(path)
    frames = values[:, 0].astype(np.int64).tolist()
    warnings: tuple[str, ...] = ()
    if size is None:
        names, num_left = _images_of(path, frames)
        headers = [read_header(path.parent / IMAGE_FOLDER / name) for name in names]
        sizes = [(header.width, header.height) for header in headers]
        if num_left:
            warnings = (f"images without a frame are not read: {num_left}",)
    else:
        names, sizes = [f"{frame:04d}" for frame in frames], [size] * len(frames)
    cameras, camera_rows = distinct_cameras(
        [_camera(path, frame, vfov, each) for frame, vfov, each in zip(frames, values[:, 7].tolist(), sizes)]
    )
    angles_rad = np.deg2rad(values[:, [5, 4, 6]])
    rotation = rotation_of_euler_angles(_AXES, angles_rad).matrix * _FLIP
    cams_from_world = Rigid3(rotation, values[:, 1:4]).inverse()
    none = Observations.none()
    model = model_of_single_images(names, cameras, camera_rows, cams_from_world, no_points(), none)
    return ModelFile(path, model, warnings)


def _values(path: Path) -> np.ndarray:
    """(n, 8) the lines of a file."""
    rows = []
    for number, line in enumerate(file_text(path, _MOST_BYTES).splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) == _COLUMNS - 1:
            raise FileFormatError(
                path, f"line {number}: it has no field of view; export a camera, not an object"
            )
        try:
            row = np.array(words, np.float64)
        except ValueError as error:
            raise FileFormatError(path, f"line {number}: not a number: {str(error)[:80]}") from error
        if len(row) != _COLUMNS or not (np.abs(row) < _FARTHEST).all():
            expected = (
                f"{_COLUMNS} finite numbers expected (frame, position, rotation, vertical field of view)"
            )
            raise FileFormatError(path, f"line {number}: {expected}, got {line.strip()[:60]!r}")
        if row[0] % 1.0 != 0.0 or abs(row[0]) >= _MOST_FRAMES:
            raise FileFormatError(path, f"line {number}: the frame {words[0][:20]} is not an integer")
        rows.append(row)
    if not rows:
        raise FileFormatError(path, "it has no frames")
    values = np.array(rows)
    frame, count = Counter(values[:, 0].tolist()).most_common(1)[0]
    if count > 1:
        raise FileFormatError(path, f"it has the frame {frame:g} {count} times")
    return values


def _images_of(path: Path, frames: Sequence[int]) -> tuple[list[str], int]:
    """The image of each frame, and the number of the other images."""
    folder = path.parent / IMAGE_FOLDER
    if not folder.is_dir():
        raise FileFormatError(
            path,
            f"it has no image size, and there is no folder {folder}: copy the images of the frames there, or pass the size to"
            " epipole.io.read_chan",
        )
    listed = list_photographs(folder).names
    name_of = dict(zip(frame_numbers(listed), listed))
    missing = next((frame for frame in frames if frame not in name_of), None)
    if missing is not None:
        raise FileFormatError(path, f"no image in {folder} has the number of frame {missing}")
    return [name_of[frame] for frame in frames], len(listed) - len(frames)


def _camera(path: Path, frame: int, vfov_deg: float, size: tuple[int, int]) -> Camera:
    width, height = size
    if not 0.0 < vfov_deg < 180.0:
        raise FileFormatError(
            path, f"frame {frame}: the field of view {vfov_deg:g} is not between 0 and 180 degrees"
        )
    with np.errstate(over="ignore", divide="ignore"):  # an infinite focal length is refused
        focal_px = 0.5 * height / np.tan(0.5 * np.deg2rad(vfov_deg))
    try:
        return Camera(
            CameraModel.SIMPLE_PINHOLE,
            width,
            height,
            np.array([focal_px, 0.5 * (width - 1), 0.5 * (height - 1)]),
        )
    except ConfigError as error:
        raise FileFormatError(path, f"frame {frame}: {error}") from error
