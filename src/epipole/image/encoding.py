"""Images encoded by OpenCV, whose encoder answers False rather than raising."""

from __future__ import annotations

import cv2
import numpy as np

from epipole.errors import ShapeError


def encoded_image(suffix: str, pixels: np.ndarray, jpeg_quality: int = 95) -> bytes:
    """The bytes of an image file.

    Args:
        suffix: of the format, such as `.png`.
        pixels: (h, w) grey, or (h, w, 3) in OpenCV's order blue, green, red.
        jpeg_quality: from 0 to 100; other formats ignore it.

    Raises:
        ShapeError: the format cannot hold the image (a JPEG has at most 65,500 pixels on a side).
    """
    options = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if suffix in (".jpg", ".jpeg") else []
    try:
        is_encoded, data = cv2.imencode(suffix, np.ascontiguousarray(pixels), options)
    except cv2.error as error:
        raise ShapeError(f"an image of {pixels.shape} cannot be written as {suffix}: {error.err}") from error
    if not is_encoded or not data.size:
        raise ShapeError(f"an image of {pixels.shape} cannot be written as {suffix}")
    return data.tobytes()
