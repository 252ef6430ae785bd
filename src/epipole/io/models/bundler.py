"""Bundler's bundle.out, version 0.3 (Snavely, Seitz, Szeliski 2006).

P = R X + t, p = -P / P.z, pixel = f (1 + k1 |p|^2 + k2 |p|^4) p from the image center, x right, y up. Rotated by 180
degrees about its x axis, this is a RADIAL camera. A camera that is not registered has f = 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import numpy as np

from epipole._checks import checked
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.io.atomic import atomic_write
from epipole.io.images.photographs import read_header
from epipole.io.models._brown import one_focal_px
from epipole.io.models._bundler_values import (
    HEADER,
    LIST_FILE,
    BundleValues,
    bundle_values,
    list_beside,
    listed_names,
)
from epipole.io.models.model_file import (
    ModelFile,
    Observations,
    distinct_cameras,
    model_of_single_images,
)
from epipole.io.names import path_inside
from epipole.scene import Points, Reconstruction

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
    lines = [HEADER, f"{len(registered)} {len(reconstruction.points)}"]
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
    focal_px = one_focal_px(camera, "Bundler")
    distortion = np.zeros(8)
    values = camera.params[list(camera.model.distortion_indices)]
    distortion[: len(values)] = values
    if camera.model == CameraModel.OPENCV_FISHEYE or distortion[2:].any():
        raise ConfigError(
            f"Bundler cannot represent the distortion of {camera.model.name}, only k1 and k2: "
            "undistort the images first"
        )
    return np.array([focal_px, distortion[0], distortion[1]])


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


@checked
def read_bundler(path: str | Path, image_folder: str = "images") -> Reconstruction:
    """Read registered cameras, points and tracks; the principal point is the image center.

    The format has no image sizes: they are read from the images, whose paths in the list of images are relative to its
    folder. Issues a Python warning for everything in `ModelFile.warnings`.

    Args:
        path: the file; the list is `list.txt` beside it, or `NAME.list.txt` for `NAME.bundle.out`.
        image_folder: prefix removed from the image names, as added by `write_bundler`.

    Raises:
        FileFormatError: not such a file, it is truncated, a value is invalid, or the list or an image is missing.
    """
    return bundler_contents(path, image_folder).warned()


@checked
def bundler_contents(path: str | Path, image_folder: str = "images") -> ModelFile:
    """Read registered cameras, points and tracks, and a warning about the other cameras.

    Args:
        path: as in `read_bundler`.
        image_folder: as in `read_bundler`.

    Raises:
        FileFormatError: as in `read_bundler`.
    """
    path = Path(path)
    values, list_file = bundle_values(path), list_beside(path)
    listed = listed_names(list_file)
    if len(listed) != len(values.intrinsics):
        raise FileFormatError(
            list_file, f"it has {len(listed)} images, but {path.name} has {len(values.intrinsics)} cameras"
        )
    registered = np.flatnonzero(values.intrinsics[:, 0] != 0.0)
    if not len(registered):
        raise FileFormatError(path, "none of its cameras is registered")
    cameras, camera_rows = distinct_cameras(
        [
            _camera(path, path_inside(list_file.parent, listed[k]), values.intrinsics[k])
            for k in registered.tolist()
        ]
    )
    rotation = Rotation3.nearest(_BUNDLER_AXES[:, None] * values.rotation[registered])
    cams_from_world = Rigid3(rotation.matrix, values.translation[registered] * _BUNDLER_AXES)
    prefix = f"{image_folder.rstrip('/')}/" if image_folder else ""
    model = model_of_single_images(
        [listed[k].removeprefix(prefix) for k in registered],
        cameras,
        camera_rows,
        cams_from_world,
        Points(values.xyz, np.rint(values.rgb).astype(np.uint8), np.full(len(values.xyz), np.nan)),
        _observations(values, registered, cameras, camera_rows),
    )
    left_out = len(listed) - len(registered)
    return ModelFile(
        path, model, (f"cameras that are not registered are not read: {left_out}",) if left_out else ()
    )


def _camera(path: Path, image: Path, intrinsics: np.ndarray) -> Camera:
    try:
        header = read_header(image)
    except FileFormatError as error:
        raise FileFormatError(path, f"it has no image sizes, and an image cannot be read: {error}") from error
    f, k1, k2 = intrinsics.tolist()
    center = 0.5 * (header.width - 1), 0.5 * (header.height - 1)
    try:
        return Camera(CameraModel.RADIAL, header.width, header.height, np.array([f, *center, k1, k2]))
    except ConfigError as error:
        raise FileFormatError(path, f"the camera of {image.name}: {error}") from error


def _observations(
    values: BundleValues, registered: np.ndarray, cameras: list[Camera], camera_rows: list[int]
) -> Observations:
    row_of_camera = np.full(len(values.intrinsics), -1)
    row_of_camera[registered] = np.arange(len(registered))
    camera, feature, _, _, point = values.views.T.astype(np.int64)
    image = row_of_camera[camera]
    centers = np.array([each.K[:2, 2] for each in cameras])[np.array(camera_rows)]
    return Observations(image, feature, point, centers[image] + values.views[:, 2:4] * [1.0, -1.0])
