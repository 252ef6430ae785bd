"""Cameras as nerfstudio's transforms.json (also read: instant-ngp's and NeRF-synthetic's).

A frame's matrix is world_from_cam with OpenGL camera axes: x right, y up, looking down -z. The principal
point counts from the corner of the picture, half a pixel before the centre of its first pixel.
"""

from __future__ import annotations

import math
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image

from epipole._declared import checked
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.io._colmap_cameras import HALF_PIXEL
from epipole.io._photograph_pixels import PILLOW_ERRORS
from epipole.io.atomic import atomic_write
from epipole.io.files import open_file, problem_of_name, read_json, require_file
from epipole.io.json_files import json_text
from epipole.io.names import path_inside
from epipole.io.ply import read_points_ply, write_points_ply
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks

POINTS_FILE = "sparse_pc.ply"
"""Name of the points that are written beside the cameras."""

_OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
_PERSPECTIVE_KEYS, _FISHEYE_KEYS = ("k1", "k2", "p1", "p2"), ("k1", "k2", "k3", "k4")
_FISHEYE_NAMES = ("OPENCV_FISHEYE", "FISHEYE")
_ORTHONORMAL_TOLERANCE = 1e-3


@checked
def write_transforms(reconstruction: Reconstruction, path: str | Path, image_folder: str = "images") -> None:
    """Write the registered cameras, and the points (if any) as a PLY file beside.

    Intrinsics stand once in the file if all images share them, otherwise in each frame.

    Args:
        reconstruction: what to write.
        path: the JSON file.
        image_folder: where the images are, seen from the JSON file's folder.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    path = Path(path)
    cams_from_world, camera_of_image = reconstruction.cams_from_world(), reconstruction.camera_of_image
    registered = np.flatnonzero(np.isfinite(cams_from_world.translation).all(axis=1)).tolist()
    used = sorted({int(camera_of_image[image]) for image in registered})
    intrinsics = {row: _intrinsics(reconstruction.cameras[row]) for row in used}
    content: dict[str, Any] = dict(intrinsics[used[0]]) if len(used) == 1 else {}
    if len(reconstruction.points):
        content["ply_file_path"] = POINTS_FILE
        points = reconstruction.points
        write_points_ply(path.with_name(POINTS_FILE), points.xyz_in_world, points.rgb)
    frames = []
    for image in registered:
        name = reconstruction.images.name[image]
        frame: dict[str, Any] = {"file_path": str(PurePosixPath(image_folder) / name)}
        if len(used) > 1:
            frame |= intrinsics[int(camera_of_image[image])]
        matrix = cams_from_world[image].inverse().as_matrix() @ _OPENGL_AXES
        frame["transform_matrix"] = matrix.tolist()
        frames.append(frame)
    content["frames"] = frames
    with atomic_write(path) as part:
        part.write_text(json_text(content), encoding="utf-8")


def _intrinsics(camera: Camera) -> dict[str, Any]:
    K, is_fisheye = camera.K, camera.model == CameraModel.OPENCV_FISHEYE
    distortion = np.zeros(8)
    values = camera.params[list(camera.model.distortion_indices)]
    distortion[: len(values)] = values
    if distortion[5:].any():
        raise ConfigError("transforms.json cannot hold a rational lens: undistort the pictures first")
    return {
        "camera_model": "OPENCV_FISHEYE" if is_fisheye else "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(K[0, 0]),
        "fl_y": float(K[1, 1]),
        "cx": float(K[0, 2] + HALF_PIXEL),
        "cy": float(K[1, 2] + HALF_PIXEL),
        **dict(zip(_FISHEYE_KEYS if is_fisheye else _PERSPECTIVE_KEYS, distortion.tolist())),
        **({"k3": float(distortion[4])} if distortion[4] else {}),
    }


@checked
def read_transforms(path: str | Path, image_folder: str = "images") -> Reconstruction:
    """Read cameras, and the points if the file names some; such a file has no keypoints and no tracks.

    Args:
        path: the JSON file.
        image_folder: taken off the front of the images' names, as `write_transforms` puts it there.

    Raises:
        FileFormatError: it is no such file, or a frame's values are impossible.
    """
    path = Path(path)
    content = _object_in(path)
    frames = content.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise FileFormatError(path, "there is no list of frames")
    names: list[str] = []
    cameras: list[Camera] = []
    camera_rows: list[int] = []
    row_of: dict[tuple, int] = {}
    worlds_from_cams: list[np.ndarray] = []
    for number, frame in enumerate(frames):
        try:
            name = _image_name(path, frame)
            camera = _camera(path, {**content, **frame}, name)
            worlds_from_cams.append(_world_from_cam(frame))
        except (ConfigError, KeyError, TypeError, ValueError, ArithmeticError, OSError) as error:
            problem = f"there is no {error}" if isinstance(error, KeyError) else str(error)
            raise FileFormatError(path, f"frame {number}: {problem}") from error
        key = (int(camera.model), camera.width, camera.height, camera.params.tobytes())
        if key not in row_of:
            row_of[key] = len(cameras)
            cameras.append(camera)
        camera_rows.append(row_of[key])
        names.append(name.removeprefix(image_folder.rstrip("/") + "/"))
    cams_from_world = Rigid3.from_matrix(np.array(worlds_from_cams).reshape(-1, 4, 4)[:, :3]).inverse()
    return model_of_cameras(names, cameras, camera_rows, cams_from_world, _points(path, content))


def _object_in(path: Path) -> dict[str, Any]:
    content = read_json(path)
    if not isinstance(content, dict):
        raise FileFormatError(path, "not a transforms file (no JSON object)")
    return content


def _image_name(path: Path, frame: dict[str, Any]) -> str:
    """The image's path as in the file; NeRF-synthetic leaves out '.png'."""
    if (problem := problem_of_name(frame["file_path"])) is not None:
        raise ConfigError(problem)
    name = str(frame["file_path"]).replace("\\", "/").removeprefix("./")
    if not Path(name).suffix and (path.parent / f"{name}.png").is_file():
        return f"{name}.png"
    return name


def _camera(path: Path, values: dict[str, Any], name: str) -> Camera:
    """The camera of one frame, whose own values go before the file's."""
    if "w" in values and "h" in values:
        width, height = int(values["w"]), int(values["h"])
    else:
        width, height = _picture_size(path_inside(path.parent, name))
    if "fl_x" in values:
        fx = float(values["fl_x"])
    else:
        angle_rad = float(values["camera_angle_x"])
        if not 0.0 < angle_rad < math.pi:
            raise ConfigError(f"camera_angle_x is {angle_rad:g}, no angle of view")
        fx = 0.5 * width / math.tan(0.5 * angle_rad)
    fy = float(values.get("fl_y", fx))
    cx, cy = float(values.get("cx", 0.5 * width)), float(values.get("cy", 0.5 * height))
    is_fisheye = values.get("camera_model") in _FISHEYE_NAMES or bool(values.get("is_fisheye", False))
    keys = _FISHEYE_KEYS if is_fisheye else _PERSPECTIVE_KEYS
    distortion = [float(values.get(key, 0.0)) for key in keys]
    k3, k4 = (0.0 if is_fisheye else float(values.get(key, 0.0)) for key in ("k3", "k4"))
    if k4 != 0.0:
        raise ConfigError("k4 of a perspective camera is not supported")
    model = CameraModel.OPENCV_FISHEYE if is_fisheye else CameraModel.OPENCV
    if k3 != 0.0:
        model, distortion = CameraModel.FULL_OPENCV, [*distortion, k3, 0.0, 0.0, 0.0]
    elif not is_fisheye and not any(distortion):
        model, distortion = CameraModel.PINHOLE, []
    params = np.array([fx, fy, cx - HALF_PIXEL, cy - HALF_PIXEL, *distortion])
    if not (0 < width < 2**31 and 0 < height < 2**31):
        raise ConfigError(f"impossible picture size {width}x{height}")
    return Camera(model, width, height, params)


def _picture_size(file: Path) -> tuple[int, int]:
    try:
        with open_file(file) as stream, Image.open(stream) as picture:
            return picture.size
    except (*PILLOW_ERRORS, FileFormatError) as error:
        raise ConfigError(f"w and h are not given, and the picture {file} cannot be read") from error


def _world_from_cam(frame: dict[str, Any]) -> np.ndarray:
    matrix = np.array(frame["transform_matrix"], np.float64)
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise ConfigError("transform_matrix is not 4x4 finite numbers")
    out = np.eye(4)
    out[:3] = matrix[:3]
    nearest = Rotation3.nearest(out[:3, :3]).matrix
    if np.abs(nearest - out[:3, :3]).max() > _ORTHONORMAL_TOLERANCE:
        raise ConfigError("transform_matrix does not hold a rotation")
    out[:3, :3] = nearest
    return out @ _OPENGL_AXES


def _points(path: Path, content: dict[str, Any]) -> Points:
    name = content.get("ply_file_path")
    if isinstance(name, str) and (problem := problem_of_name(name)) is not None:
        raise FileFormatError(path, f"ply_file_path: {problem}")
    try:
        file = path_inside(path.parent, name) if isinstance(name, str) and name else None
        is_there = file is not None and file.exists()
        if file is not None and is_there:
            require_file(file)
    except OSError as error:
        raise FileFormatError(path, f"ply_file_path: {error.strerror}") from error
    except FileFormatError as error:
        raise FileFormatError(path, f"ply_file_path: {error}") from error
    if file is None or not is_there:
        return Points(np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0))
    cloud = read_points_ply(file)
    rgb = cloud.rgb if cloud.rgb is not None else np.full((len(cloud), 3), 128, np.uint8)
    return Points(cloud.xyz, rgb, np.full(len(cloud), np.nan))


@checked
def model_of_cameras(
    names: list[str], cameras: list[Camera], camera_rows: list[int], cams_from_world: Rigid3, points: Points
) -> Reconstruction:
    """Images with cameras and poses, without keypoints and tracks."""
    n, rows = len(names), np.array(camera_rows, np.int32)
    no_keypoints = np.zeros(n + 1, np.int64)
    images = Images(tuple(names), np.arange(n, dtype=np.int32), rows, no_keypoints, np.empty((0, 2)))
    return Reconstruction(
        Cameras.from_list(cameras),
        Rigs.of_single_cameras(len(cameras)),
        Frames(rows.copy(), cams_from_world, np.full(n, np.nan)),
        images,
        points,
        Tracks(np.zeros(len(points) + 1, np.int64), np.empty(0, np.int32), np.empty(0, np.int32)),
    )
