"""Decoding of images, depth and cameras from ROS messages (sensor_msgs: Image, CompressedImage, CameraInfo)."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, FileFormatError
from epipole.io.calibration.coefficients import camera_of_coefficients, require_plain
from epipole.io.calibration.model_names import named_model, refuse_binning, require_coefficients
from epipole.io.images.deep_pixels import GrayScale, scale_of
from epipole.io.images.depth_maps import png16_in
from epipole.io.images.pixels import decode_bytes, deep_gray

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, IMU = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Imu"
_MM = 1000.0
_MOST_PX = 1 << 28
_DEPTH_HEADER = struct.Struct("<iff")
"""Header of compressed_depth_image_transport: the kind, and two quantization parameters."""

# Channels, and OpenCV's conversion to gray. OpenCV names Bayer patterns by their second row, ROS by the first.
_TO_GRAY: dict[str, tuple[int, int | None]] = {
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
    **dict.fromkeys(("yuv422_yuy2", "yuyv", "yuy2"), (2, cv2.COLOR_YUV2GRAY_YUY2)),
}
_DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}


def encoding_of(message: Any) -> str:
    """Encoding of an image: `bgr8`, `16UC1`, or the format of a compressed one; empty for other messages."""
    return str(getattr(message, "encoding", getattr(message, "format", "")))


def _require_image(path: Path, topic: str, message: Any) -> None:
    """Reject messages of other types, which a damaged connection list can assign to a topic."""
    if not (hasattr(message, "data") and (hasattr(message, "encoding") or hasattr(message, "format"))):
        raise FileFormatError(path, f"{topic}: a message is not an image")


def is_depth(topic: str, encoding: str) -> bool:
    """Whether images with this encoding are depth; 16-bit images may also be gray."""
    if "compresseddepth" in encoding.lower() or "32FC1" in encoding:
        return True
    return encoding.split(";")[0].strip() in _DEPTHS and ("16UC1" in encoding or "depth" in topic.lower())


def values_per_meter(encoding: str) -> float:
    """Depth values per meter according to REP 118: 16-bit integers are millimeters, floats are meters."""
    return 1.0 if "32FC1" in encoding else _MM


def gray_of(path: Path, topic: str, message: Any, scale: GrayScale | None = None) -> UInt8[np.ndarray, "h w"]:
    """Decode the image of a message to 8-bit gray.

    Args:
        path: the recording, for error messages.
        topic: the topic, for error messages.
        message: an Image or a CompressedImage.
        scale: conversion of 16 bits to 8, common to all messages of the topic; None: from this message.

    Raises:
        FileFormatError: the message is inconsistent, or its encoding is not supported.
    """
    _require_image(path, topic, message)
    if not hasattr(message, "encoding"):
        return _decompressed(path, topic, message, scale)
    encoding = str(message.encoding)
    is_deep, plain = _as_8_bits(encoding)
    if plain not in _TO_GRAY:
        raise FileFormatError(path, f"{topic}: the image encoding {encoding[:60]!r} is not supported")
    channels, conversion = _TO_GRAY[plain]
    pixels = _values(path, topic, message, channels, "u2" if is_deep else "u1")
    if is_deep:
        pixels = (scale_of([pixels]) if scale is None else scale).apply(pixels)
    return _converted(path, topic, pixels, conversion)


def gray_scale(path: Path, topic: str, messages: Sequence[Any]) -> GrayScale | None:
    """Conversion of a topic's images to 8 bits, determined from some of them; None if they have 8 bits.

    Raises:
        FileFormatError: as in `gray_of`.
    """
    deep = []
    for message in messages:
        _require_image(path, topic, message)
        if not hasattr(message, "encoding"):
            values = deep_gray(path, bytes(message.data))
        else:
            is_deep, plain = _as_8_bits(str(message.encoding))
            if not is_deep or plain not in _TO_GRAY:
                return None
            values = _values(path, topic, message, _TO_GRAY[plain][0], "u2")
        if values is None:
            return None
        deep.append(values)
    return scale_of(deep) if deep else None


def _as_8_bits(encoding: str) -> tuple[bool, str]:
    """Whether an encoding has 16 bits per channel, and its 8-bit counterpart."""
    if encoding.endswith("16"):
        return True, f"{encoding[:-2]}8"
    return encoding.startswith("16UC"), encoding.replace("16UC", "8UC")


def _decompressed(path: Path, topic: str, message: Any, scale: GrayScale | None) -> UInt8[np.ndarray, "h w"]:
    """Decode `FORMAT; jpeg compressed FORMAT` (image_transport); the compressed image may be a raw Bayer mosaic."""
    gray = decode_bytes(path, bytes(message.data), True, None, None if scale is None else scale.range)
    words = str(message.format).replace(";", " ").split()
    _, plain = _as_8_bits(words[3 if len(words) > 3 else 0] if words else "")
    if not plain.startswith("bayer_"):
        return gray
    if plain not in _TO_GRAY:
        raise FileFormatError(path, f"{topic}: the image encoding {plain[:60]!r} is not supported")
    return _converted(path, topic, gray[:, :, None], _TO_GRAY[plain][1])


def _converted(
    path: Path, topic: str, pixels: UInt8[np.ndarray, "h w c"], conversion: int | None
) -> UInt8[np.ndarray, "h w"]:
    if conversion is None:
        return np.ascontiguousarray(pixels[:, :, 0])
    try:
        flat = np.ascontiguousarray(pixels if pixels.shape[2] > 1 else pixels[:, :, 0])
        return np.asarray(cv2.cvtColor(flat, conversion), np.uint8)
    except cv2.error as error:  # Bayer and YUV images need at least two pixels per side
        raise FileFormatError(path, f"{topic}: the image cannot be made gray ({error.err})") from error


def depth_of(path: Path, topic: str, message: Any) -> Float32[np.ndarray, "h w"]:
    """Decode depth in meters along the optical axis (REP 118: integers are millimeters, floats meters); 0 if unknown.

    Raises:
        FileFormatError: the message is inconsistent, or not a depth image.
    """
    _require_image(path, topic, message)
    encoding = encoding_of(message)
    if not hasattr(message, "encoding"):
        meters = _compressed_depth(path, topic, bytes(message.data), encoding)
    elif encoding in _DEPTHS:
        kind = _DEPTHS[encoding]
        meters = _values(path, topic, message, 1, kind)[:, :, 0].astype(np.float32)
        if kind == "u2":
            meters = np.where(meters == 65535, 0.0, meters / np.float32(_MM))
    else:
        raise FileFormatError(path, f"{topic}: images with the encoding {encoding[:60]!r} are not depth")
    is_known = np.isfinite(meters) & (meters > 0)
    return np.where(is_known, meters, 0.0).astype(np.float32)


def camera_of(path: Path, message: Any, *, is_rectified: bool) -> Camera | None:
    """The camera of a CameraInfo; None if it is not calibrated (fx is zero).

    Args:
        path: the recording, for error messages.
        message: the CameraInfo.
        is_rectified: return the camera of the rectified images, whose camera matrix is the left part of P.

    Raises:
        FileFormatError: the numbers are not a valid camera, or the distortion model is not supported.
    """
    size = int(message.width), int(message.height)
    words = str(message.distortion_model)
    K, coefficients = field(message, "k").reshape(3, 3), field(message, "d")
    if is_rectified:
        K, coefficients = field(message, "p").reshape(3, 4)[:, :3], np.zeros(4)
        words = "plumb_bob"
    if not K[0, 0]:
        return None
    camera = named_model(path, {"distortion_model": words})
    roi = getattr(message, "roi", None)
    refuse_binning(
        path,
        {name: getattr(message, name, 0) for name in ("binning_x", "binning_y")}
        | {"roi": {name: getattr(roi, name, 0) for name in ("x_offset", "y_offset")}},
    )
    if not np.isfinite(np.concatenate([K.ravel(), coefficients])).all():
        raise FileFormatError(path, "a number in a CameraInfo is not finite")
    require_plain(path, K)
    require_coefficients(path, camera, coefficients)
    if not camera.is_fisheye and not coefficients.any():
        return _pinhole(path, size, K)
    return camera_of_coefficients(path, size, K, coefficients, is_fisheye=camera.is_fisheye)


def _pinhole(path: Path, size: tuple[int, int], K: np.ndarray) -> Camera:
    try:
        return Camera(CameraModel.PINHOLE, *size, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]))
    except ConfigError as error:
        raise FileFormatError(path, str(error)) from error


def field(message: Any, name: str) -> np.ndarray:
    """Numbers of a CameraInfo field; ROS 1 has upper-case names."""
    return np.asarray(
        getattr(message, name) if hasattr(message, name) else getattr(message, name.upper()), np.float64
    )


def _values(path: Path, topic: str, message: Any, channels: int, kind: str) -> np.ndarray:
    """Pixel values (h, w, channels) of an uncompressed message."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    kind = (">" if message.is_bigendian else "<") + kind
    row = width * channels * np.dtype(kind).itemsize
    data = np.asarray(message.data, np.uint8)
    if min(height, width) < 1 or height * width > _MOST_PX or step < row or len(data) < step * height:
        raise FileFormatError(
            path,
            f"{topic}: {len(data)} bytes in rows of {step} do not match an image of {width} x {height} pixels",
        )
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :row])
    return rows.view(kind).reshape(height, width, channels).astype(kind[1:], copy=False)


def _compressed_depth(path: Path, topic: str, data: bytes, encoding: str) -> np.ndarray:
    """Decode a PNG after a header of twelve bytes; floats are stored as a / (number - b)."""
    if "compresseddepth" not in encoding.lower():
        return np.asarray(png16_in(path, data, _MM))
    if len(data) < _DEPTH_HEADER.size:
        raise FileFormatError(path, f"{topic}: a depth image of {len(data)} bytes is truncated")
    _, a, b = _DEPTH_HEADER.unpack_from(data)
    data = data[_DEPTH_HEADER.size :]
    if "32FC1" not in encoding:
        return np.asarray(png16_in(path, data, _MM))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.asarray(a / (png16_in(path, data, 1.0) - b), np.float32)
