"""Bundler's bundle.out, version 0.3 (Snavely, Seitz, Szeliski 2006)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import numpy as np

from epipole._checks import checked
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError
from epipole.io.atomic import atomic_write
from epipole.scene import Reconstruction

LIST_FILE = "list.txt"
"""Name of the image list, written beside the model."""
MAX_ASPECT_DIFFERENCE = 0.01
"""Bundler has one focal length: fx and fy may differ by at most this fraction."""

_BUNDLER_AXES = np.array([1.0, -1.0, -1.0])


@checked
def write_bundler(reconstruction: Reconstruction, path: str | Path, image_folder: str = "") -> None:
    """Write the registered cameras and the points, with a `list.txt` beside them.

    A Bundler camera looks down -z, with y up, and has f, k1 and k2. Pixels are relative to the principal point, which
    the format assumes to be the image center; the file stays consistent if it is not.

    Args:
        reconstruction: the model to write.
        path: the file.
        image_folder: folder of the images, relative to the file's folder.

    Raises:
        ConfigError: the format cannot represent a camera's distortion (undistort the images first).
        WorkspaceError: a file cannot be written.
    """
    path = Path(path)
    cams_from_world = reconstruction.cams_from_world()
    is_written = np.isfinite(cams_from_world.translation).all(axis=1)
    registered = np.flatnonzero(is_written).tolist()
    lines = ["# Bundle file v0.3", f"{len(registered)} {len(reconstruction.points)}"]
    for image in registered:
        focal_and_radial = _bundler_intrinsics(
            reconstruction.cameras[int(reconstruction.camera_of_image[image])]
        )
        rotation = _BUNDLER_AXES[:, None] * cams_from_world.rotation[image]
        lines.append(_numbers(focal_and_radial))
        lines.extend(_numbers(row) for row in rotation)
        lines.append(_numbers(_BUNDLER_AXES * cams_from_world.translation[image]))
    with atomic_write(path) as part, part.open("w", encoding="utf-8", newline="\n") as stream:
        stream.writelines(f"{line}\n" for line in lines)
        stream.writelines(f"{line}\n" for line in _point_lines(reconstruction, is_written))
    with atomic_write(path.with_name(LIST_FILE)) as part:
        names = (PurePosixPath(image_folder) / reconstruction.images.name[image] for image in registered)
        part.write_text("".join(f"{name}\n" for name in names), encoding="utf-8", newline="\n")


def _bundler_intrinsics(camera: Camera) -> np.ndarray:
    """(f, k1, k2)."""
    fx, fy = camera.K[0, 0], camera.K[1, 1]
    if abs(fx - fy) > MAX_ASPECT_DIFFERENCE * fx:
        raise ConfigError(f"Bundler has a single focal length, but this camera has {fx:g} and {fy:g}")
    distortion = np.zeros(8)
    values = camera.params[list(camera.model.distortion_indices)]
    distortion[: len(values)] = values
    if camera.model == CameraModel.OPENCV_FISHEYE or distortion[2:].any():
        raise ConfigError(
            f"Bundler cannot represent the distortion of {camera.model.name}, only k1 and k2: "
            "undistort the images first"
        )
    return np.array([camera.focal_px, distortion[0], distortion[1]])


def _numbers(values: np.ndarray) -> str:
    return " ".join(map(repr, values.tolist()))


def _point_lines(reconstruction: Reconstruction, is_written: np.ndarray) -> Iterator[str]:
    """Three lines per point: position, color, and the cameras and keypoints that observe it."""
    tracks, points = reconstruction.tracks, reconstruction.points
    camera_row = np.cumsum(is_written) - 1
    principal = np.array([reconstruction.cameras[i].K[:2, 2] for i in range(len(reconstruction.cameras))])
    principal = principal.reshape(-1, 2)[reconstruction.camera_of_image]
    pixels = (reconstruction.observed_pixels() - principal[tracks.image]) * np.array([1.0, -1.0])
    for j in range(len(points)):
        rows = np.arange(tracks.offsets[j], tracks.offsets[j + 1])
        rows = rows[is_written[tracks.image[rows]]]
        yield _numbers(points.xyz_in_world[j])
        yield _numbers(points.rgb[j])
        views = (
            f"{camera_row[tracks.image[k]]} {tracks.keypoint[k]} {_numbers(pixels[k])}" for k in rows.tolist()
        )
        yield " ".join([str(len(rows)), *views])
