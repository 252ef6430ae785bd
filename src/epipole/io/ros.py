"""Poses, points, images and cameras as the fields of ROS 2 messages: nested dictionaries, named as in the definitions.

They need no ROS: `epipole.io.bags.writing` stores them, and in a node `rosidl_runtime_py.set_message_fields(message, fields)` copies
them to a message. Frames follow REP 103 and 105; a camera's frame has x right, y down and z forward (an optical frame).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from epipole._checks import checked
from epipole.cameras import Camera
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.io.calibration.coefficients import coefficients_of_camera

REP103_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation from optical axes to those of REP 103 (x forward, y left, z up)."""
UNKNOWN_VARIANCE = 1e6
"""Variance in m^2 or rad^2 of what is not known. Odometry has no mark for it, and filters that read it take any number at its word."""
_FLOAT32 = 7
"""sensor_msgs/msg/PointField.FLOAT32"""
_DISTORTION = {
    "plumb_bob": "plumb_bob",
    "rational_polynomial": "rational_polynomial",
    "fisheye": "equidistant",
}


@checked
def header_fields(stamp_s: float, frame: str) -> dict[str, Any]:
    """std_msgs/msg/Header.

    Raises:
        ConfigError: the time is not finite, or does not fit into a message.
    """
    if not abs(stamp_s) < 2**31:
        raise ConfigError(f"a message of ROS cannot have the time {stamp_s:g} s: its seconds have 32 bits")
    seconds, nanoseconds = divmod(round(stamp_s * 1e9), 10**9)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}


@checked
def transform_fields(stamp_s: float, parent_from_child: Rigid3, parent: str, child: str) -> dict[str, Any]:
    """geometry_msgs/msg/TransformStamped: the pose of a frame in its parent.

    Raises:
        ConfigError: the time does not fit into a message.
    """
    pose = _pose(parent_from_child)
    transform = {"translation": pose["position"], "rotation": pose["orientation"]}
    return {"header": header_fields(stamp_s, parent), "child_frame_id": child, "transform": transform}


@checked
def odometry_fields(
    stamp_s: float,
    world_from_body: Rigid3,
    covariance: Float64[np.ndarray, "6 6"] | None,
    world: str,
    body: str,
) -> dict[str, Any]:
    """nav_msgs/msg/Odometry: a pose with its covariance; the velocity is not known.

    ROS describes an error of the pose by the shift of the position and by a small rotation about the fixed axes of the world. To first
    order these are -R xi_t and -R xi_r for body_from_world = exp(xi) @ estimate, with R the rotation of world_from_body.

    Args:
        stamp_s: time.
        world_from_body: the pose.
        covariance: of xi = (translation, rotation), as in `TrackedFrame`; None or not finite if unknown: then the variances of
            position or rotation are `UNKNOWN_VARIANCE`.
        world: name of the world's frame.
        body: name of the body's frame.

    Raises:
        ConfigError: the time does not fit into a message.
    """
    unknown = UNKNOWN_VARIANCE * np.eye(6)
    known = unknown if covariance is None else _in_fixed_axes(covariance, world_from_body.rotation)
    zero = {"x": 0.0, "y": 0.0, "z": 0.0}
    return {
        "header": header_fields(stamp_s, world),
        "child_frame_id": body,
        "pose": {"pose": _pose(world_from_body), "covariance": known.ravel()},
        "twist": {"twist": {"linear": zero, "angular": zero}, "covariance": unknown.ravel()},
    }


def _in_fixed_axes(covariance: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Covariance of position and rotation about the axes of the world; of the two, one that is not finite is unknown."""
    out, parts = np.array(covariance, np.float64), (slice(0, 3), slice(3, 6))
    for part in parts:
        if not np.isfinite(out[part, part]).all():
            out[part], out[:, part] = 0.0, 0.0
            out[part, part] = UNKNOWN_VARIANCE * np.eye(3)
    if not np.isfinite(out).all():
        return UNKNOWN_VARIANCE * np.eye(6)
    both = np.kron(np.eye(2), rotation)
    return both @ out @ both.T


@checked
def path_fields(
    stamps_s: Float64[np.ndarray, " n"], world_from_body: Rigid3, world: str, stamp_s: float
) -> dict[str, Any]:
    """nav_msgs/msg/Path: poses (n,) with their times.

    Raises:
        ConfigError: a time does not fit into a message.
        ShapeError: there are not as many poses as times.
    """
    if world_from_body.rotation.shape != (len(stamps_s), 3, 3):
        raise ShapeError(f"{len(stamps_s)} times need as many poses, got {world_from_body!r}")
    poses = [
        {"header": header_fields(time, world), "pose": _pose(world_from_body[n])}
        for n, time in enumerate(stamps_s.tolist())
    ]
    return {"header": header_fields(stamp_s, world), "poses": poses}


@checked
def points_fields(stamp_s: float, xyz: Float64[np.ndarray, "n 3"], frame: str) -> dict[str, Any]:
    """sensor_msgs/msg/PointCloud2: points as three 32-bit numbers each.

    Raises:
        ConfigError: the time does not fit into a message.
    """
    fields = [
        {"name": name, "offset": 4 * n, "datatype": _FLOAT32, "count": 1} for n, name in enumerate("xyz")
    ]
    return {
        "header": header_fields(stamp_s, frame),
        "height": 1,
        "width": len(xyz),
        "fields": fields,
        "is_bigendian": False,
        "point_step": 12,
        "row_step": 12 * len(xyz),
        "data": np.frombuffer(xyz.astype("<f4").tobytes(), np.uint8),
        "is_dense": bool(np.isfinite(xyz).all()),
    }


@checked
def jpeg_fields(
    stamp_s: float, image: UInt8[np.ndarray, "h w *rgb"], frame: str, quality: int = 90
) -> dict[str, Any]:
    """sensor_msgs/msg/CompressedImage: a gray (h, w) or RGB (h, w, 3) image as JPEG.

    Raises:
        ConfigError: the image is empty or has another number of channels, or the quality or the time is out of range.
    """
    if not 1 <= quality <= 100:
        raise ConfigError(f"quality must be between 1 and 100, got {quality}")
    if image.size == 0 or image.ndim > 3 or (image.ndim == 3 and image.shape[2] != 3):
        raise ConfigError(f"an image must be gray or RGB and not empty, but its shape is {image.shape}")
    stored = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    data = cv2.imencode(".jpg", stored, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return {"header": header_fields(stamp_s, frame), "format": "jpeg", "data": data.ravel()}


@checked
def camera_info_fields(stamp_s: float, camera: Camera, frame: str) -> dict[str, Any]:
    """sensor_msgs/msg/CameraInfo.

    Raises:
        ConfigError: the time does not fit into a message.
    """
    model, coefficients = coefficients_of_camera(camera)
    projection = np.hstack([camera.K, np.zeros((3, 1))])
    region = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    return {
        "header": header_fields(stamp_s, frame),
        "height": camera.height,
        "width": camera.width,
        "distortion_model": _DISTORTION[model],
        "d": coefficients,
        "k": camera.K.ravel(),
        "r": np.eye(3).ravel(),
        "p": projection.ravel(),
        "binning_x": 0,
        "binning_y": 0,
        "roi": region,
    }


def _pose(parent_from_child: Rigid3) -> dict[str, Any]:
    """geometry_msgs/msg/Pose."""
    position = dict(zip("xyz", parent_from_child.translation.tolist()))
    return {
        "position": position,
        "orientation": dict(zip("wxyz", Rotation3(parent_from_child.rotation).as_quat_wxyz().tolist())),
    }
