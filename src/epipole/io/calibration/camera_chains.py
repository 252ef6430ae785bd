"""Calibrations of camera chains: Kalibr's camchain, OpenVINS' kalibr_imucam_chain, and camodocal camera files (VINS).

Kalibr's T_a_b is a_from_b: T_cn_cnm1 is this camera from the previous one, T_cam_imu is the camera from the IMU.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from epipole.cameras import Camera
from epipole.errors import FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.io._named_numbers import numbers_of, size_of
from epipole.io.calibration.coefficients import camera_of_coefficients
from epipole.io.calibration.model_names import NamedModel, named_model, require_coefficients

_CAMERA = re.compile(r"cam(\d{1,3})")
_ROUNDED_ROTATION = 1e-3
"""Largest entry of R R^T - 1 attributed to rounding: files store three or more digits."""
_SAME_ANGLE_RAD, _SAME_OFFSET = 0.02, 0.05
"""Tolerance between two derivations of the same camera pose: angle, and fraction of the longer baseline."""


def is_chain(content: Mapping[str, Any]) -> bool:
    """Whether it has Kalibr's cameras cam0, cam1 ..."""
    return any(_CAMERA.fullmatch(key) and isinstance(value, Mapping) for key, value in content.items())


def is_link(content: Mapping[str, Any]) -> bool:
    """Whether it is a single camera of a chain, without an enclosing key cam0."""
    return (
        "intrinsics" in content
        and "T_BS" not in content
        and ("resolution" in content or "distortion_coeffs" in content)
    )


def is_camodocal(content: Mapping[str, Any]) -> bool:
    """Whether it is a camodocal camera file, as used by VINS."""
    return "model_type" in content and "projection_parameters" in content


def chain_cameras(
    path: Path, content: Mapping[str, Any], size: tuple[int, int] | None
) -> tuple[tuple[Camera, ...], Rigid3]:
    """Cameras and cam_from_rig; the rig's frame is that of the first camera.

    Raises:
        FileFormatError: a camera, its pose or a number is missing, or a camera model is not supported.
    """
    if is_link(content):
        content = {"cam0": content}
    count = max(int(match[1]) for key in content if (match := _CAMERA.fullmatch(key))) + 1
    cameras: list[Camera] = []
    links: list[Mapping[str, Any]] = []
    poses = [Rigid3(np.eye(3), np.zeros(3))]
    for k in range(count):
        own = content.get(f"cam{k}")
        if not isinstance(own, Mapping):
            raise FileFormatError(path, f"the key cam{k} is missing")
        cameras.append(_camera(path, own, size))
        links.append(own)
        if k:
            poses.append(_from_last(path, links[k - 1], own, f"cam{k}") @ poses[-1])
    return tuple(cameras), Rigid3(
        np.stack([pose.rotation for pose in poses]), np.stack([pose.translation for pose in poses])
    )


def _camera(path: Path, own: Mapping[str, Any], size: tuple[int, int] | None) -> Camera:
    if "resolution" in own or size is None:
        size = size_of(path, *numbers_of(path, own, "resolution", 2))
    return camera_of_intrinsics(path, size, own, "distortion_coeffs")


def camera_of_intrinsics(path: Path, size: tuple[int, int], content: Mapping[str, Any], key: str) -> Camera:
    """The camera from the keys of Kalibr and EuRoC: model names, intrinsics (fx, fy, cx, cy), and coefficients.

    Args:
        path: the file.
        size: image width and height.
        content: names and values in the file.
        key: name of the coefficients.

    Raises:
        FileFormatError: a model name is unknown, a number is missing, or the numbers are not a valid camera.
    """
    words = named_model(path, content)
    if key not in content and (words.is_without_distortion or not words.is_named):
        coefficients = np.zeros(4)
    else:
        coefficients = numbers_of(path, content, key)
    require_coefficients(path, words, coefficients)
    if not words.is_named and coefficients.any():
        raise FileFormatError(path, f"{key} are given, but the key distortion_model is missing")
    fx, fy, cx, cy = numbers_of(path, content, "intrinsics", 4)
    return _camera_of(path, size, (fx, fy, cx, cy), coefficients, words)


def _camera_of(
    path: Path,
    size: tuple[int, int],
    intrinsics: tuple[float, ...],
    coefficients: np.ndarray,
    words: NamedModel,
) -> Camera:
    fx, fy, cx, cy = intrinsics
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return camera_of_coefficients(path, size, K, coefficients, is_fisheye=words.is_fisheye)


def _from_last(path: Path, last: Mapping[str, Any], own: Mapping[str, Any], name: str) -> Rigid3:
    """A camera's pose in the previous one: from the chain, or else by way of the IMU."""
    chained = motion_of(path, own, "T_cn_cnm1") if "T_cn_cnm1" in own else None
    cam_from_imu, last_from_imu = camera_from_imu(path, own), camera_from_imu(path, last)
    if cam_from_imu is None or last_from_imu is None:
        if chained is None:
            raise FileFormatError(
                path, f"{name}: the key T_cn_cnm1 is missing (or T_cam_imu of this and the previous camera)"
            )
        return chained
    by_imu = cam_from_imu @ last_from_imu.inverse()
    if chained is None:
        return by_imu
    if not _is_same(chained, by_imu):
        raise FileFormatError(
            path, f"{name}: T_cn_cnm1 contradicts T_cam_imu (or T_imu_cam) of the two cameras"
        )
    return chained


def camera_from_imu(path: Path, own: Mapping[str, Any]) -> Rigid3 | None:
    """A camera's pose from T_cam_imu or T_imu_cam; None if it has neither.

    Raises:
        FileFormatError: the matrix is not a rigid motion, or the two contradict each other.
    """
    motion = motion_of(path, own, "T_cam_imu") if "T_cam_imu" in own else None
    if "T_imu_cam" not in own:
        return motion
    inverse = motion_of(path, own, "T_imu_cam").inverse()
    if motion is not None and not _is_same(motion, inverse):
        raise FileFormatError(path, "T_imu_cam is not the inverse of T_cam_imu")
    return inverse


def motion_of(path: Path, own: Mapping[str, Any], key: str) -> Rigid3:
    """The rigid motion of a 4 x 4 matrix, whose rotation may be rounded.

    Raises:
        FileFormatError: the matrix is missing, or is not a rigid motion.
    """
    matrix = numbers_of(path, own, key, 4, 4)
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not error <= _ROUNDED_ROTATION or np.linalg.det(rotation) <= 0 or (matrix[3] != [0, 0, 0, 1]).any():
        raise FileFormatError(path, f"{key} is not a motion: R R^T is not 1, or the last row is not 0 0 0 1")
    return Rigid3(Rotation3.nearest(rotation).matrix, matrix[:3, 3])


def _is_same(first: Rigid3, second: Rigid3) -> bool:
    offset = np.linalg.norm(first.translation - second.translation)
    length = max(np.linalg.norm(first.translation), np.linalg.norm(second.translation))
    angle = np.linalg.norm(Rotation3(first.rotation @ second.rotation.T).log())
    return bool(angle <= _SAME_ANGLE_RAD and offset <= _SAME_OFFSET * length)


def camodocal_camera(path: Path, content: Mapping[str, Any], size: tuple[int, int]) -> Camera:
    """PINHOLE with k1, k2, p1, p2, or KANNALA_BRANDT with k2 to k5, which OpenCV calls k1 to k4.

    Raises:
        FileFormatError: the model is not supported, or a number is missing.
    """
    words = named_model(path, content)
    projection = _group(path, content, "projection_parameters")
    if words.is_fisheye:
        names, coefficients = (
            ("mu", "mv", "u0", "v0"),
            [projection[k] for k in _present(path, projection, "k2 k3 k4 k5")],
        )
    else:
        camera = _group(path, content, "distortion_parameters")
        names, coefficients = (
            ("fx", "fy", "cx", "cy"),
            [camera[k] for k in _present(path, camera, "k1 k2 p1 p2")],
        )
    intrinsics = tuple(float(projection[name]) for name in _present(path, projection, " ".join(names)))
    return _camera_of(path, size, intrinsics, np.array(coefficients), words)


def _group(path: Path, content: Mapping[str, Any], key: str) -> dict[str, float]:
    group = content.get(key)
    if not isinstance(group, Mapping):
        raise FileFormatError(path, f"the key {key} is missing")
    return {str(name): float(numbers_of(path, group, name, 1)[0]) for name in group}


def _present(path: Path, group: Mapping[str, float], names: str) -> list[str]:
    missing = [name for name in names.split() if name not in group]
    if missing:
        raise FileFormatError(path, f"the keys {', '.join(missing)} are missing")
    return names.split()
