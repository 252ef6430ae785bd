"""Turning pixels by an EXIF orientation, and back."""

from __future__ import annotations

import cv2
import numpy as np

from epipole.cameras.image_fit import inverse_orientation


def as_stored(pixels: np.ndarray, stored: int | None, left: int, orientation: int | None) -> np.ndarray:
    """The pixels to which another orientation than the file's is to be applied.

    Pillow turns a TIFF as it loads it: what is `left` of its `stored` orientation then is 1. Where another one is asked
    for, that is taken back.
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
