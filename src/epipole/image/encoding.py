"""Image encoding with OpenCV, with exceptions instead of a status."""

from __future__ import annotations

import cv2
import numpy as np

from epipole.errors import ShapeError


def encoded_image(suffix: str, pixels: np.ndarray, jpeg_quality: int = 95) -> bytes:
    """Encode an image as the bytes of an image file.

    Args:
        suffix: suffix of the format, such as `.png`.
        pixels: (h, w) gray, or (h, w, 3) in OpenCV's order blue, green, red.
        jpeg_quality: from 0 to 100; other formats ignore it.

    Raises:
        ShapeError: the format does not support the image (JPEG is limited to 65,500 pixels per side).
    """
    options = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if suffix in (".jpg", ".jpeg") else []
    try:
        is_encoded, data = cv2.imencode(suffix, np.ascontiguousarray(pixels), options)
    except cv2.error as error:
        raise ShapeError(
            f"an image of shape {pixels.shape} cannot be encoded as {suffix}: {error.err}"
        ) from error
    if not is_encoded or not data.size:
        raise ShapeError(f"an image of shape {pixels.shape} cannot be encoded as {suffix}")
    return data.tobytes()
