"""Files of disparity and depth maps: PFM (float) and 16-bit PNG."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32

from epipole._checks import as_float_array, checked
from epipole.errors import ConfigError, FileFormatError, ShapeError
from epipole.image.encoding import encoded_image
from epipole.io.atomic import atomic_write
from epipole.io.files import file_bytes

PNG_SCALE = 256.0
"""KITTI's scale: a stored number is 256 times the value; 0 means unknown."""
_MOST_PIXELS = 1 << 28
_LONGEST_HEADER = 1 << 16
_SIGNATURE = 8


@checked
def write_pfm(path: str | Path, values: Any) -> None:
    """Write a map (h, w) as a one-channel PFM: 32-bit floats, little-endian, last row first; NaN stays NaN.

    Raises:
        ShapeError: the array is not a map.
        WorkspaceError: the file cannot be written.
    """
    array = _map(values)
    height, width = array.shape
    with atomic_write(path) as aside:
        aside.write_bytes(f"Pf\n{width} {height}\n-1.0\n".encode() + array[::-1].astype("<f4").tobytes())


@checked
def read_pfm(path: str | Path) -> Float32[np.ndarray, "h w"]:
    """Read a one-channel PFM of either byte order.

    Raises:
        FileFormatError: the file is damaged or missing.
    """
    path = Path(path)
    parts = file_bytes(path, 4 * _MOST_PIXELS + _LONGEST_HEADER).split(b"\n", 3)
    try:
        kind, (width, height), scale = parts[0].strip(), map(int, parts[1].split()), float(parts[2])
        data = parts[3]
    except (IndexError, ValueError) as error:
        raise FileFormatError(path, "it has no valid PFM header; export or copy it again") from error
    if kind != b"Pf":
        raise FileFormatError(path, f"it starts with {kind[:8]!r}; a one-channel PFM starts with 'Pf'")
    if min(width, height) < 1 or width * height > _MOST_PIXELS or not (np.isfinite(scale) and scale):
        raise FileFormatError(path, "line 2 or 3: the size or the scale is not valid")
    if len(data) != 4 * width * height:
        raise FileFormatError(
            path, f"{width} x {height} pixels need {4 * width * height} bytes, got {len(data)}"
        )
    order = "<f4" if scale < 0 else ">f4"
    return np.frombuffer(data, order).reshape(height, width)[::-1].astype(np.float32)


@checked
def write_png16(path: str | Path, values: Any, scale: float = PNG_SCALE) -> None:
    """Write a map (h, w) as 16-bit PNG, round(scale * value); 0 where NaN or out of range.

    Raises:
        ShapeError: the array is not a map.
        ConfigError: the scale is not positive.
        WorkspaceError: the file cannot be written.
    """
    array = _map(values)
    if not scale > 0:
        raise ConfigError(f"scale must be positive, got {scale}")
    with np.errstate(invalid="ignore"):
        scaled = np.rint(scale * array)
        stored = np.where((scaled >= 1) & (scaled <= 65535), scaled, 0)
    data = encoded_image(".png", stored.astype(np.uint16))
    with atomic_write(path) as aside:
        aside.write_bytes(data)


@checked
def read_png16(path: str | Path, scale: float = PNG_SCALE) -> Float32[np.ndarray, "h w"]:
    """Read a map written by `write_png16` or from KITTI; 0 becomes NaN.

    Raises:
        FileFormatError: the file is damaged, missing, or not a 16-bit image with one channel.
    """
    path = Path(path)
    return png16_in(path, file_bytes(path, 4 * _MOST_PIXELS), scale)


@checked
def png16_in(path: Path, data: bytes, scale: float = PNG_SCALE) -> Float32[np.ndarray, "h w"]:
    """Decode a map from the bytes of a 16-bit PNG; 0 becomes NaN.

    Args:
        path: the file, for error messages.
        data: the PNG.
        scale: ratio of stored number to value.

    Raises:
        FileFormatError: the data are damaged, or not a 16-bit image with one channel.
    """
    # OpenCV would also accept other formats, such as PFM.
    array = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if _is_png16(data) else None
    if array is None or array.ndim != 2 or array.dtype != np.uint16:
        raise FileFormatError(path, "it is not a 16-bit PNG with one channel")
    return np.where(array > 0, array / np.float32(scale), np.float32(np.nan)).astype(np.float32)


def _is_png16(data: bytes) -> bool:
    """Whether the header is that of a 16-bit gray PNG with a plausible size (PNG 1.2, 4.1.1).

    Deflate compresses by a factor of at most 1032, so a header that claims more pixels is wrong, and the file is not
    decoded.
    """
    if not data.startswith(b"\x89PNG\r\n\x1a\n") or data[12:16] != b"IHDR" or len(data) < 26:
        return False
    width, height, depth, color = struct.unpack_from(">IIBB", data, 16)
    return (
        (depth, color) == (16, 0)
        and 2 * width * height <= min(1032 * len(data), 2 * _MOST_PIXELS)
        and _is_one_image(data)
    )


def _is_one_image(data: bytes) -> bool:
    """Whether all chunks fit into the file and none belongs to an animation: OpenCV allocates memory by their claims."""
    at = _SIGNATURE
    while at + 12 <= len(data):
        length, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        at += 12 + length
        if at > len(data) or kind in (b"acTL", b"fcTL", b"fdAT"):
            return False
        if kind == b"IEND":
            return True
    return False


def _map(values: Any) -> np.ndarray:
    array = as_float_array(values, "values")
    if array.ndim != 2 or array.size == 0:
        raise ShapeError(f"values must be a map (h, w), got {array.shape}")
    return array
