"""Calibration files: epipole's JSON with covariances, OpenCV's YAML/XML/JSON, ROS' camera_info, Kalibr's camchain.

EuRoC, KITTI and Middlebury files, and the settings of ORB-SLAM and OKVIS can also be read.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from jaxtyping import Float64

from epipole._checks import checked
from epipole.cameras import Camera, CameraModel, camera_model_named
from epipole.errors import EpipoleError, FileFormatError, ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.io._named_numbers import is_rotation, numbers_of, size_of, xml_values, yaml_values
from epipole.io.atomic import atomic_write
from epipole.io.calibration import _datasets as datasets
from epipole.io.calibration._mrcal import is_mrcal, is_mrcal_text, mrcal_cameras, mrcal_values
from epipole.io.calibration.camera_chains import (
    camodocal_camera,
    chain_cameras,
    is_camodocal,
    is_chain,
    is_link,
)
from epipole.io.calibration.cameras import CalibrationFile as CalibrationFile
from epipole.io.calibration.coefficients import camera_of_coefficients, coefficients_of_camera
from epipole.io.calibration.folders import calibration_files
from epipole.io.calibration.model_names import named_model, refuse_binning, require_coefficients
from epipole.io.calibration.slam_settings import is_okvis, is_orb_slam, okvis_cameras, orb_slam_cameras
from epipole.io.files import file_bytes
from epipole.io.json_files import json_text, json_values
from epipole.scene import StereoRig

FORMAT = "epipole calibration"
_VERSION = 1
_MOST_BYTES = 1 << 23
_OPENCV_VERSION = re.compile(r"^%YAML:.*$", re.MULTILINE)
_OPENCV_TAG = re.compile(r"!!opencv-[a-z-]+")
_SIZES = (("image_width", "image_height"), ("width", "height"), ("imageWidth", "imageHeight"))
_SINGLE_KEYS = (
    ("camera_matrix", "distortion_coefficients"),
    ("Camera_Matrix", "Distortion_Coefficients"),
    ("cameraMatrix", "distCoeffs"),
    ("M", "D"),
)
_PAIR_KEYS = (
    ("M1", "D1", "M2", "D2"),
    ("K1", "D1", "K2", "D2"),
    ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"),
)


@checked
def read_calibration(*paths: str | Path, size: tuple[int, int] | None = None) -> CalibrationFile:
    """Read cameras, and their relative poses if the files have them.

    Args:
        paths: one file; or two: those of the left and the right camera (ROS, EuRoC), or intrinsics and extrinsics (OpenCV's sample); or
            a folder with those of two cameras (`left.yaml` and `right.yaml`).
        size: width and height of the images, for files without them (OpenCV's stereo sample, KITTI).

    Raises:
        FileFormatError: a file cannot be read; the message names the missing key.
    """
    files = [Path(p) for p in paths]
    if len(files) == 1:
        files = calibration_files(files[0])
    if len(files) not in (1, 2):
        raise FileFormatError(files[0] if files else "calibration", "expected one or two files")
    try:
        found = _read(files, size)
    except ShapeError as error:
        raise FileFormatError(
            files[-1], f"a camera pose is not a rigid motion: R R^T is not 1 ({error})"
        ) from error
    for k, (rotation, translation) in enumerate(
        zip(found.cam_from_rig.rotation, found.cam_from_rig.translation)
    ):
        if not (np.isfinite(translation).all() and is_rotation(rotation)):
            raise FileFormatError(
                files[-1],
                f"the pose of camera {k} is not a rigid motion: it is not finite, or R R^T is not 1",
            )
    return found


def _read(files: list[Path], size: tuple[int, int] | None) -> CalibrationFile:
    contents = [parsed_file(path) for path in files]
    if any(is_mrcal(content) for content in contents):
        return CalibrationFile(*mrcal_cameras(files, contents))
    with_camera = [k for k, content in enumerate(contents) if _is_single(content)]
    if len(files) == 2 and len(with_camera) == 2:
        return _left_and_right(files, contents, size)
    if all(datasets.is_euroc(content) for content in contents):
        return CalibrationFile(*datasets.euroc_cameras(files, contents))
    if len(files) == 2 and any(_is_whole(content) for content in contents):
        whole = files[0 if _is_whole(contents[0]) else 1]
        raise FileFormatError(whole, "it has all cameras: pass only this file")
    merged: dict[str, Any] = {}
    for content in contents:
        merged |= content
    path = files[0]
    for is_its, cameras_of in (
        (datasets.is_middlebury, datasets.middlebury_cameras),
        (datasets.is_kitti, datasets.kitti_cameras),
    ):
        if is_its(merged):
            return CalibrationFile(*cameras_of(path, merged, size))
    if merged.get("format") == FORMAT:
        return _own(path, merged)
    if is_chain(merged) or is_link(merged):
        return CalibrationFile(*chain_cameras(path, merged, size))
    if is_orb_slam(merged):
        return CalibrationFile(*orb_slam_cameras(path, merged, size))
    if is_okvis(merged):
        return CalibrationFile(*okvis_cameras(path, merged))
    if is_camodocal(merged):
        camera = camodocal_camera(path, merged, _size(path, merged, size))
        return CalibrationFile((camera,), Rigid3.identity(1))
    if _is_single(merged):
        return CalibrationFile((_single(path, merged, size),), Rigid3.identity(1))
    return _opencv_pair(path, merged, size)


@checked
def read_body_from_camera(path: str | Path) -> Rigid3:
    """Read a camera's pose in the body (IMU) from EuRoC's `sensor.yaml` (T_BS): body_from_camera.

    Raises:
        FileFormatError: the file does not have one.
    """
    path = Path(path)
    try:
        return datasets.body_from_camera(path, parsed_file(path))
    except (KeyError, TypeError, ValueError) as error:
        raise FileFormatError(path, f"T_BS cannot be read: {error}") from error


@checked
def read_stereo_rig(
    *paths: str | Path, size: tuple[int, int] | None = None, cameras: tuple[int, int] | None = None
) -> StereoRig:
    """Read a pair of cameras.

    Args:
        paths: as in `read_calibration`.
        size: as in `read_calibration`.
        cameras: which two of the file's cameras, left and right, counted from 0.

    Raises:
        FileFormatError: a file cannot be read, has only one camera, or has more than two and `cameras` is None.
    """
    found = read_calibration(*paths, size=size)
    if len(found.cameras) < 2:
        raise FileFormatError(
            paths[0], "it has one camera; depth needs two and their relative pose (R and T)"
        )
    count = len(found.cameras)
    if cameras is None and count > 2:
        raise FileFormatError(paths[0], f"it has {count} cameras: choose two, for example cameras 0 1")
    left, right = cameras or (0, 1)
    if left == right or not (0 <= left < count and 0 <= right < count):
        raise FileFormatError(
            paths[0], f"it has cameras 0 to {count - 1}: {left} and {right} are not a pair of them"
        )
    motion = found.cam_from_rig[right] @ found.cam_from_rig[left].inverse()
    covariance = found.covariance if (left, right) == (0, 1) else None
    try:
        return StereoRig(found.cameras[left], found.cameras[right], motion, covariance)
    except EpipoleError as error:
        raise FileFormatError(paths[0], str(error)) from error


@checked
def write_calibration(
    path: str | Path, calibration: CalibrationFile, about: Mapping[str, Any] | None = None
) -> None:
    """Write epipole's JSON: cameras, their poses, covariance, and further information under `about`.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    content = {
        "format": FORMAT,
        "version": _VERSION,
        "cameras": [
            {
                "model": camera.model.name,
                "width": camera.width,
                "height": camera.height,
                "params": dict(zip(camera.model.param_names, camera.params.tolist())),
                "cam_from_rig": {
                    "quat_wxyz": Rotation3(calibration.cam_from_rig.rotation[k]).as_quat_wxyz().tolist(),
                    "translation": calibration.cam_from_rig.translation[k].tolist(),
                },
            }
            for k, camera in enumerate(calibration.cameras)
        ],
        "covariance": None if calibration.covariance is None else calibration.covariance.tolist(),
        "about": dict(about or {}),
    }
    with atomic_write(path) as aside:
        aside.write_text(json_text(content, indent=1), encoding="utf-8")


@checked
def write_opencv_yaml(path: str | Path, calibration: CalibrationFile) -> None:
    """Write the format of OpenCV's samples: camera_matrix and distortion_coefficients, or M1, D1, M2, D2, R, T.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    first = calibration.cameras[0]
    storage.write("image_width", first.width)
    storage.write("image_height", first.height)
    storage.write("fisheye_model", int(first.model == CameraModel.OPENCV_FISHEYE))
    if len(calibration.cameras) == 1:
        storage.write("camera_matrix", first.K)
        storage.write("distortion_coefficients", coefficients_of_camera(first)[1].reshape(-1, 1))
    else:
        for k, camera in enumerate(calibration.cameras[:2], 1):
            storage.write(f"M{k}", camera.K)
            storage.write(f"D{k}", coefficients_of_camera(camera)[1].reshape(1, -1))
        storage.write("R", calibration.cam_from_rig.rotation[1])
        storage.write("T", calibration.cam_from_rig.translation[1].reshape(3, 1))
    with atomic_write(path) as aside:
        aside.write_text(storage.releaseAndGetString(), encoding="utf-8")


@checked
def write_ros_yaml(
    path: str | Path,
    camera: Camera,
    name: str,
    rectification: Float64[np.ndarray, "3 3"] | None = None,
    projection: Float64[np.ndarray, "3 4"] | None = None,
) -> None:
    """Write a ROS camera_info YAML of one camera, with rectification and rectified projection if it belongs to a pair.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    model, coefficients = coefficients_of_camera(camera)
    p = np.column_stack([camera.K, np.zeros(3)]) if projection is None else projection
    content = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": _ros_matrix(camera.K),
        "distortion_model": "equidistant" if model == "fisheye" else model,
        "distortion_coefficients": _ros_matrix(coefficients.reshape(1, -1)),
        "rectification_matrix": _ros_matrix(np.eye(3) if rectification is None else rectification),
        "projection_matrix": _ros_matrix(p),
    }
    with atomic_write(path) as aside:
        aside.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None), encoding="utf-8")


def _ros_matrix(matrix: np.ndarray) -> dict[str, Any]:
    return {"rows": matrix.shape[0], "cols": matrix.shape[1], "data": [float(v) for v in matrix.ravel()]}


@checked
def parsed_file(path: Path) -> dict[str, Any]:
    """Parse a file in YAML, JSON, OpenCV's XML, mrcal's or KITTI's format into names and values.

    Raises:
        FileFormatError: the file is in none of these formats.
    """
    data = file_bytes(path, _MOST_BYTES)
    head = data.lstrip()[:200]
    try:
        if head.startswith((b"<?xml", b"<opencv_storage")):
            return xml_values(data)
        text = data.decode("utf-8-sig")
        if lines := datasets.named_lines(text):
            return lines
        if is_mrcal_text(text):
            return mrcal_values(text)
        # OpenCV's version line and its matrices are not standard YAML.
        text = _OPENCV_TAG.sub("", _OPENCV_VERSION.sub("", text, count=1))
        content = json_values(path, text, allow_nan=True) if head.startswith(b"{") else yaml_values(text)
    except FileFormatError:
        raise
    except ValueError as error:
        raise FileFormatError(path, f"it is neither JSON nor YAML: {str(error).split(chr(10))[0]}") from error
    if not isinstance(content, dict):
        raise FileFormatError(path, "it has no named values")
    return {str(key): value for key, value in content.items()}


def _size(path: Path, content: Mapping[str, Any], given: tuple[int, int] | None) -> tuple[int, int]:
    for width, height in _SIZES:
        if width in content and height in content:
            return size_of(path, *(numbers_of(path, content, key, 1)[0] for key in (width, height)))
    if given is None:
        raise FileFormatError(path, "the keys image_width and image_height are missing")
    return given


def _is_whole(content: Mapping[str, Any]) -> bool:
    return content.get("format") == FORMAT or is_chain(content) or datasets.is_kitti(content)


def _is_single(content: Mapping[str, Any]) -> bool:
    return any(matrix in content for matrix, _ in _SINGLE_KEYS)


def _single(path: Path, content: Mapping[str, Any], size: tuple[int, int] | None) -> Camera:
    matrix, coefficients = next(keys for keys in _SINGLE_KEYS if keys[0] in content)
    refuse_binning(path, content)
    return _camera(path, content, (matrix, coefficients), _size(path, content, size))


def _camera(path: Path, content: Mapping[str, Any], keys: tuple[str, str], size: tuple[int, int]) -> Camera:
    words = named_model(path, content)
    K = numbers_of(path, content, keys[0], 3, 3)
    is_empty = words.is_without_distortion and keys[1] not in content
    d = np.zeros(4) if is_empty else numbers_of(path, content, keys[1])
    require_coefficients(path, words, d)
    return camera_of_coefficients(path, size, K, d, is_fisheye=words.is_fisheye)


def _left_and_right(
    files: list[Path], contents: list[dict[str, Any]], size: tuple[int, int] | None
) -> CalibrationFile:
    """ROS: x_rectified = R x, and P[0, 3] of the right camera is -f B."""
    cameras = tuple(_single(path, content, size) for path, content in zip(files, contents))
    rotations = [numbers_of(p, c, "rectification_matrix", 3, 3) for p, c in zip(files, contents)]
    projections = [numbers_of(p, c, "projection_matrix", 3, 4) for p, c in zip(files, contents)]
    offsets = [p[:, 3] / p[0, 0] for p in projections]
    if not np.abs(offsets[1] - offsets[0]).max() > 0:
        raise FileFormatError(files[1], "its projection_matrix has no baseline (entry 1, 4 is zero)")
    rotation = rotations[1].T @ rotations[0]
    translation = rotations[1].T @ (offsets[1] - offsets[0])
    return CalibrationFile(
        cameras, Rigid3(np.stack([np.eye(3), rotation]), np.stack([np.zeros(3), translation]))
    )


def _opencv_pair(path: Path, content: Mapping[str, Any], size: tuple[int, int] | None) -> CalibrationFile:
    keys = next(
        (names for names in _PAIR_KEYS if any(n in content for n in (names[0], names[2]))), _PAIR_KEYS[0]
    )
    missing = [key for key in (*keys, "R", "T") if key not in content]
    if missing:
        raise FileFormatError(
            path, f"{'the key' if len(missing) == 1 else 'the keys'} {', '.join(missing)} missing"
        )
    shape = _size(path, content, size)
    cameras = tuple(_camera(path, content, pair, shape) for pair in (keys[:2], keys[2:]))
    rotation, translation = numbers_of(path, content, "R", 3, 3), numbers_of(path, content, "T", 3)
    return CalibrationFile(
        cameras, Rigid3(np.stack([np.eye(3), rotation]), np.stack([np.zeros(3), translation]))
    )


def _own(path: Path, content: Mapping[str, Any]) -> CalibrationFile:
    if content.get("version") != _VERSION:
        raise FileFormatError(
            path, f"unsupported version {content.get('version')}; this epipole reads version {_VERSION}"
        )
    try:
        cameras, rotations, translations = [], [], []
        for own in content["cameras"]:
            model = camera_model_named(str(own["model"]))
            params = np.array([float(own["params"][name]) for name in model.param_names])
            if unknown := sorted(set(own["params"]) - set(model.param_names)):
                raise FileFormatError(path, f"{model.name} has no parameter {', '.join(unknown)[:80]}")
            cameras.append(Camera(model, *size_of(path, float(own["width"]), float(own["height"])), params))
            position = own["cam_from_rig"]
            quaternion = np.asarray(position["quat_wxyz"], np.float64).reshape(4)
            if not 1e-9 < np.abs(quaternion).max() < 1e9:
                raise FileFormatError(path, "a quaternion is zero or not finite")
            rotations.append(Rotation3.from_quat_wxyz(quaternion).matrix)
            translations.append(np.asarray(position["translation"], np.float64).reshape(3))
        if not cameras:
            raise FileFormatError(path, "it has no cameras")
        covariance = content.get("covariance")
        matrix = None if covariance is None else np.asarray(covariance, np.float64).reshape(30, 30)
    except KeyError as error:
        raise FileFormatError(path, f"the key {error.args[0]} is missing") from error
    except FileFormatError:
        raise
    except (TypeError, ValueError, OverflowError) as error:
        raise FileFormatError(path, f"invalid values: {error}") from error
    return CalibrationFile(tuple(cameras), Rigid3(np.stack(rotations), np.stack(translations)), matrix)
