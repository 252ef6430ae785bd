"""Rotating and flipping pixels by EXIF orientation, and the inverse."""

from __future__ import annotations

import cv2
import numpy as np

from epipole.cameras.image_fit import inverse_orientation


def as_stored(pixels: np.ndarray, stored: int | None, left: int, orientation: int | None) -> np.ndarray:
    """Undo the rotation that Pillow applied on loading, if another orientation than the file's is requested.

    Pillow rotates a TIFF while loading it, which sets its `stored` orientation to `left` = 1.
    """
    if orientation is None or stored is None or stored == left:
        return pixels
    return rotation(pixels, inverse_orientation(stored))


def rotation(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Apply an EXIF orientation."""
    if orientation in (5, 6, 7, 8):
        pixels = cv2.transpose(pixels)
    flip = {2: 1, 3: -1, 4: 0, 6: 1, 7: -1, 8: 0}.get(orientation)
    return np.ascontiguousarray(pixels if flip is None else cv2.flip(pixels, flip))
