"""Cameras in the settings files of ORB-SLAM2, ORB-SLAM3 and OKVIS.

ORB-SLAM's files have flat names (`Camera.fx`, since version 3 also `Camera1.fx`); T_c1_c2 and Tlr are camera1_from_camera2, and `Camera.bf`
is the baseline times fx. OKVIS lists cameras with T_SC, which is imu_from_camera.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from epipole.cameras import Camera
from epipole.errors import FileFormatError
from epipole.geometry import Rigid3
from epipole.io._named_numbers import numbers_of, size_of
from epipole.io.calibration.camera_chains import camera_of_intrinsics, motion_of
from epipole.io.calibration.coefficients import camera_of_coefficients

_FISHEYE, _PERSPECTIVE, _RECTIFIED = "KannalaBrandt8", "PinHole", "Rectified"
_DEPTH = ("RGBD.DepthMapFactor", "DepthMapFactor")
_OKVIS_MODELS = {
    "radialtangential": "radtan",
    "radialtangential8": "rational_polynomial",
    "equidistant": "equidistant",
    "none": "none",
}


def is_orb_slam(content: Mapping[str, Any]) -> bool:
    """Whether it is a settings file of ORB-SLAM2 or ORB-SLAM3."""
    return "Camera.fx" in content or "Camera1.fx" in content


def is_okvis(content: Mapping[str, Any]) -> bool:
    """Whether it is a configuration of OKVIS."""
    cameras = content.get("cameras")
    return isinstance(cameras, list) and any(isinstance(c, Mapping) and "T_SC" in c for c in cameras)


def orb_slam_cameras(
    path: Path, content: Mapping[str, Any], size: tuple[int, int] | None
) -> tuple[tuple[Camera, ...], Rigid3]:
    """Cameras and cam_from_rig of ORB-SLAM's settings; the rig's frame is that of the first camera.

    With a depth sensor there is one camera, whose `bf` or `Stereo.b` is only a unit of distance.

    Raises:
        FileFormatError: a number is missing, the model is unknown, or a stereo pair is neither rectified nor described.
    """
    first = "Camera1" if "Camera1.fx" in content else "Camera"
    kind = str(content.get("Camera.type", _PERSPECTIVE))
    if kind not in (_FISHEYE, _PERSPECTIVE, _RECTIFIED):
        raise FileFormatError(path, f"Camera.type is {kind}, not {_PERSPECTIVE}, {_FISHEYE} or {_RECTIFIED}")
    if "LEFT.K" in content:
        return _raw_pair(path, content, _size(path, content, size, ("LEFT", "Camera")))
    shape = _size(path, content, size, ("Camera",))
    camera = _camera(path, content, first, kind, shape)
    if any(key in content for key in _DEPTH):
        return (camera,), Rigid3.identity(1)
    if "Camera2.fx" in content and kind != _RECTIFIED:
        key = next(
            (key for key in ("Stereo.T_c1_c2", "Tlr", "Stereo.Tlr") if key in content), "Stereo.T_c1_c2"
        )
        second_from_first = square_motion(path, content, key).inverse()
        return (camera, _camera(path, content, "Camera2", kind, shape)), _rig(second_from_first)
    baseline = _baseline(path, content, camera)
    if baseline is None:
        return (camera,), Rigid3.identity(1)
    if camera.params[list(camera.model.distortion_indices)].any():
        raise FileFormatError(
            path,
            "it has a baseline (Camera.bf or Stereo.b) and distortion, but not the second camera: give images and settings that are"
            " rectified, or the calibration of both cameras",
        )
    return (camera, camera), _rig(Rigid3(np.eye(3), np.array([-baseline, 0.0, 0.0])))


def _baseline(path: Path, content: Mapping[str, Any], camera: Camera) -> float | None:
    """Baseline of a rectified pair in meters; None if there is one camera."""
    if "Stereo.b" in content:
        found = float(numbers_of(path, content, "Stereo.b", 1)[0])
    elif "Camera.bf" in content:
        found = float(numbers_of(path, content, "Camera.bf", 1)[0]) / float(camera.K[0, 0])
    else:
        return None
    if not found > 0:
        raise FileFormatError(path, "the baseline (Camera.bf or Stereo.b) is not positive")
    return found


def _rig(second_from_first: Rigid3) -> Rigid3:
    return Rigid3(
        np.stack([np.eye(3), second_from_first.rotation]),
        np.stack([np.zeros(3), second_from_first.translation]),
    )


def _size(
    path: Path, content: Mapping[str, Any], size: tuple[int, int] | None, names: tuple[str, ...]
) -> tuple[int, int]:
    for width, height in ((f"{name}.width", f"{name}.height") for name in names):
        if width in content and height in content:
            return size_of(path, *(numbers_of(path, content, key, 1)[0] for key in (width, height)))
    if size is None:
        raise FileFormatError(path, "the keys Camera.width and Camera.height are missing")
    return size


def _camera(path: Path, content: Mapping[str, Any], name: str, kind: str, size: tuple[int, int]) -> Camera:
    fx, fy, cx, cy = (
        float(numbers_of(path, content, f"{name}.{key}", 1)[0]) for key in ("fx", "fy", "cx", "cy")
    )
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    names = ("k1", "k2", "k3", "k4") if kind == _FISHEYE else ("k1", "k2", "p1", "p2", "k3")
    given = [key for key in names if f"{name}.{key}" in content]
    if kind == _RECTIFIED:
        given = []
    elif kind == _FISHEYE and not given:
        raise FileFormatError(path, f"the keys {name}.k1 to {name}.k4 are missing")
    elif given and (kind == _FISHEYE or len(given) < 4) and given != list(names[:4]):
        raise FileFormatError(
            path, f"the distortion of {name} has {', '.join(given)}, not {', '.join(names[:4])}"
        )
    coefficients = np.array([float(numbers_of(path, content, f"{name}.{key}", 1)[0]) for key in given])
    d = coefficients if len(given) else np.zeros(4)
    return camera_of_coefficients(path, size, K, d, is_fisheye=kind == _FISHEYE)


def square_motion(path: Path, content: Mapping[str, Any], key: str) -> Rigid3:
    """The rigid motion of a matrix with three or four rows.

    Raises:
        FileFormatError: it has another size, or is not a rigid motion.
    """
    values = numbers_of(path, content, key)
    if len(values) not in (12, 16):
        raise FileFormatError(path, f"{key} is neither 3 x 4 nor 4 x 4 numbers")
    matrix = np.append(values, [0.0, 0.0, 0.0, 1.0])[:16].reshape(4, 4)
    return motion_of(path, {key: matrix}, key)


def _raw_pair(
    path: Path, content: Mapping[str, Any], size: tuple[int, int]
) -> tuple[tuple[Camera, ...], Rigid3]:
    """The cameras of images that ORB-SLAM rectifies: x_rectified = R x, and P[0, 3] of the right camera is -f B."""
    cameras, rotations, offsets = [], [], []
    for side in ("LEFT", "RIGHT"):
        K = numbers_of(path, content, f"{side}.K", 3, 3)
        d = numbers_of(path, content, f"{side}.D")
        cameras.append(camera_of_coefficients(path, size, K, d, is_fisheye=False))
        rotations.append(numbers_of(path, content, f"{side}.R", 3, 3))
        projection = numbers_of(path, content, f"{side}.P", 3, 4)
        if not projection[0, 0] > 0:
            raise FileFormatError(path, f"{side}.P has no positive focal length")
        offsets.append(projection[:, 3] / projection[0, 0])
    if not np.abs(offsets[1] - offsets[0]).max() > 0:
        raise FileFormatError(path, "RIGHT.P has no baseline (entry 1, 4 is zero)")
    return tuple(cameras), _rig(
        Rigid3(rotations[1].T @ rotations[0], rotations[1].T @ (offsets[1] - offsets[0]))
    )


def okvis_cameras(path: Path, content: Mapping[str, Any]) -> tuple[tuple[Camera, ...], Rigid3]:
    """Cameras and cam_from_rig of OKVIS' configuration; the rig's frame is that of the first camera.

    Raises:
        FileFormatError: a number is missing, or a camera model is not supported.
    """
    cameras, imu_from_camera = [], []
    for number, own in enumerate(content["cameras"]):
        if not isinstance(own, Mapping):
            raise FileFormatError(path, f"camera {number} has no named values")
        kind = str(own.get("distortion_type", "none")).lower()
        if kind not in _OKVIS_MODELS:
            raise FileFormatError(path, f"distortion_type {kind} is not supported")
        focal, center = (numbers_of(path, own, key, 2) for key in ("focal_length", "principal_point"))
        named: dict[str, Any] = {"distortion_model": _OKVIS_MODELS[kind], "intrinsics": [*focal, *center]}
        if kind != "none":
            named["distortion_coeffs"] = numbers_of(path, own, "distortion_coefficients")
        size = size_of(path, *numbers_of(path, own, "image_dimension", 2))
        cameras.append(camera_of_intrinsics(path, size, named, "distortion_coeffs"))
        imu_from_camera.append(motion_of(path, own, "T_SC"))
    poses = [pose.inverse() @ imu_from_camera[0] for pose in imu_from_camera]
    return tuple(cameras), Rigid3(
        np.stack([pose.rotation for pose in poses]), np.stack([pose.translation for pose in poses])
    )
