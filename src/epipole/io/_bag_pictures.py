"""Pictures, depth and cameras in ROS' messages (sensor_msgs: Image, CompressedImage, CameraInfo)."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, FileFormatError
from epipole.io._lens_coefficients import camera_of_coefficients
from epipole.io._photograph_pixels import decode_bytes
from epipole.io.depth_maps import png16_in

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, IMU = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Imu"
_MM = 1000.0
_MOST_PX = 1 << 28
_DEPTH_HEADER = struct.Struct("<iff")
"""Of compressed_depth_image_transport: the kind, and two numbers of its quantization."""

# Channels, and OpenCV's conversion to grey. It names Bayer patterns by their second row, ROS by the first.
_TO_GREY: dict[str, tuple[int, int | None]] = {
    **dict.fromkeys(("mono8", "8UC1"), (1, None)),
    **dict.fromkeys(("bgr8", "8UC3"), (3, cv2.COLOR_BGR2GRAY)),
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    **dict.fromkeys(("bgra8", "8UC4"), (4, cv2.COLOR_BGRA2GRAY)),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY),
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2GRAY),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2GRAY),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2GRAY),
    **dict.fromkeys(("yuv422", "uyvy"), (2, cv2.COLOR_YUV2GRAY_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, cv2.COLOR_YUV2GRAY_YUY2)),
}
_DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}


def encoding_of(message: Any) -> str:
    """How a picture is written: `bgr8`, `16UC1`, or the format of a compressed one."""
    return str(message.encoding if hasattr(message, "encoding") else message.format)


def is_depth(topic: str, encoding: str) -> bool:
    """Whether pictures of this encoding hold depth; 16 bits alone may be grey."""
    if "compresseddepth" in encoding.lower() or "32FC1" in encoding:
        return True
    return encoding.split(";")[0].strip() in _DEPTHS and ("16UC1" in encoding or "depth" in topic.lower())


def values_per_metre(encoding: str) -> float:
    """What REP 118 has for depth of this encoding: 16 bits are millimetres, floats are metres."""
    return 1.0 if "32FC1" in encoding else _MM


def grey_of(path: Path, topic: str, message: Any) -> UInt8[np.ndarray, "h w"]:
    """The picture of a message in grey; 16 bits are cut to the upper 8.

    Raises:
        FileFormatError: its numbers do not fit each other, or the encoding is not known.
    """
    if not hasattr(message, "encoding"):
        return decode_bytes(path, bytes(message.data), True, None)
    encoding = str(message.encoding)
    if encoding in ("mono16", "16UC1"):
        return (_values(path, topic, message, 1, "u2")[:, :, 0] >> 8).astype(np.uint8)
    if encoding not in _TO_GREY:
        raise FileFormatError(path, f"{topic}: pictures of the encoding {encoding[:60]!r} are not read")
    channels, conversion = _TO_GREY[encoding]
    pixels = _values(path, topic, message, channels, "u1")
    if conversion is None:
        return np.ascontiguousarray(pixels[:, :, 0])
    try:
        flat = np.ascontiguousarray(pixels if channels > 1 else pixels[:, :, 0])
        return np.asarray(cv2.cvtColor(flat, conversion), np.uint8)
    except cv2.error as error:  # Bayer and YUV need sides of two pixels and more
        raise FileFormatError(path, f"{topic}: the picture cannot be made grey ({error.err})") from error


def depth_of(path: Path, topic: str, message: Any) -> Float32[np.ndarray, "h w"]:
    """Metres along the axis (REP 118: 16 bits are millimetres, floats are metres); 0 where not known.

    Raises:
        FileFormatError: its numbers do not fit each other, or it holds no depth.
    """
    encoding = encoding_of(message)
    if not hasattr(message, "encoding"):
        metres = _compressed_depth(path, topic, bytes(message.data), encoding)
    elif encoding in _DEPTHS:
        kind = _DEPTHS[encoding]
        metres = _values(path, topic, message, 1, kind)[:, :, 0].astype(np.float32)
        if kind == "u2":
            metres = np.where(metres == 65535, 0.0, metres / np.float32(_MM))
    else:
        raise FileFormatError(path, f"{topic}: pictures of the encoding {encoding[:60]!r} hold no depth")
    is_known = np.isfinite(metres) & (metres > 0)
    return np.where(is_known, metres, 0.0).astype(np.float32)


def camera_of(path: Path, message: Any, *, is_rectified: bool) -> Camera | None:
    """The camera that a CameraInfo tells; None where it was not calibrated (fx is zero).

    Args:
        path: of the recording, for errors.
        message: the CameraInfo.
        is_rectified: of the rectified pictures, whose camera matrix is the left part of P.

    Raises:
        FileFormatError: the numbers make no camera, or the distortion is not known.
    """
    size = int(message.width), int(message.height)
    words = str(message.distortion_model)
    K, coefficients = field(message, "k").reshape(3, 3), field(message, "d")
    if is_rectified:
        K, coefficients = field(message, "p").reshape(3, 4)[:, :3], np.zeros(4)
        words = "plumb_bob"
    if not K[0, 0]:
        return None
    if words not in ("", "none", "plumb_bob", "rational_polynomial", "equidistant", "fisheye"):
        raise FileFormatError(path, f"the distortion_model {words[:60]} is not known")
    if not np.isfinite(np.concatenate([K.ravel(), coefficients])).all():
        raise FileFormatError(path, "a number of a CameraInfo is not finite")
    is_fisheye = words in ("equidistant", "fisheye")
    if not is_fisheye and not coefficients.any():
        return _pinhole(path, size, K)
    return camera_of_coefficients(path, size, K, coefficients, is_fisheye=is_fisheye)


def _pinhole(path: Path, size: tuple[int, int], K: np.ndarray) -> Camera:
    try:
        return Camera(CameraModel.PINHOLE, *size, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]))
    except ConfigError as error:
        raise FileFormatError(path, str(error)) from error


def field(message: Any, name: str) -> np.ndarray:
    """Numbers of a CameraInfo, whose fields are upper case in ROS 1."""
    return np.asarray(
        getattr(message, name) if hasattr(message, name) else getattr(message, name.upper()), np.float64
    )


def _values(path: Path, topic: str, message: Any, channels: int, kind: str) -> np.ndarray:
    """Numbers (h, w, channels) of a message that is not compressed."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    kind = (">" if message.is_bigendian else "<") + kind
    row = width * channels * np.dtype(kind).itemsize
    data = np.asarray(message.data, np.uint8)
    if min(height, width) < 1 or height * width > _MOST_PX or step < row or len(data) < step * height:
        raise FileFormatError(
            path, f"{topic}: {len(data)} bytes in rows of {step} are no picture of {width} x {height} pixels"
        )
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :row])
    return rows.view(kind).reshape(height, width, channels).astype(kind[1:], copy=False)


def _compressed_depth(path: Path, topic: str, data: bytes, encoding: str) -> np.ndarray:
    """PNG behind a header of twelve bytes; floats are stored as a / (number - b)."""
    if "compresseddepth" not in encoding.lower():
        return np.asarray(png16_in(path, data, _MM))
    if len(data) < _DEPTH_HEADER.size:
        raise FileFormatError(path, f"{topic}: a depth picture of {len(data)} bytes is cut off")
    _, a, b = _DEPTH_HEADER.unpack_from(data)
    data = data[_DEPTH_HEADER.size :]
    if "32FC1" not in encoding:
        return np.asarray(png16_in(path, data, _MM))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.asarray(a / (png16_in(path, data, 1.0) - b), np.float32)
