"""Square markers with a number: AprilTags and ArUco markers in a picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8

from epipole.config import check_dictionary

_opencv: Any = cv2  # its stubs lack parts of aruco
_LEAST_SIDE_PX = 12.0
"""Of a smaller marker the refined corners are drawn towards each other."""
_LEAST_PICTURE = 32
_WINDOW_SHARE, _LARGEST_WINDOW = 0.1, 5
"""Half the window in which a corner is refined, over the marker's side, and at most: no further than its own black border."""
_REFINE = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)


@dataclass(frozen=True, slots=True, eq=False)
class TagView:
    """Markers found in one picture."""

    number: Int64[np.ndarray, " n"]
    corners: Float64[np.ndarray, "n 4 2"]
    """Corners of the black square, clockwise from the top left of the marker as it is printed upright."""

    def __len__(self) -> int:
        return len(self.number)

    def __repr__(self) -> str:
        return f"TagView({len(self)} markers)"


def find_tags(grey: UInt8[np.ndarray, "h w"], dictionary: str) -> TagView:
    """The markers that OpenCV's detector finds, each number once; those seen twice in a picture are left out.

    Args:
        grey: the picture.
        dictionary: OpenCV's name without DICT_, such as APRILTAG_36h11 or 4X4_50.

    Raises:
        ConfigError: there is no such dictionary.
    """
    check_dictionary(dictionary)
    none = TagView(np.zeros(0, np.int64), np.zeros((0, 4, 2)))
    if min(grey.shape) < _LEAST_PICTURE:
        return none
    grey = np.ascontiguousarray(grey)
    known = _opencv.aruco.getPredefinedDictionary(getattr(_opencv.aruco, f"DICT_{dictionary}"))
    corners, ids, _ = _opencv.aruco.ArucoDetector(known, _opencv.aruco.DetectorParameters()).detectMarkers(
        grey
    )
    if ids is None:
        return none
    numbers, counts = np.unique(ids.ravel(), return_counts=True)
    single = numbers[counts == 1]
    found = {int(n): c.reshape(4, 2).astype(np.float64) for n, c in zip(ids.ravel(), corners)}
    rows = []
    for number in single:
        pixels = found[int(number)]
        side = float(np.linalg.norm(pixels - np.roll(pixels, 1, axis=0), axis=1).min())
        if side < _LEAST_SIDE_PX:
            continue
        half = int(np.clip(_WINDOW_SHARE * side, 1, _LARGEST_WINDOW))
        start = np.ascontiguousarray(pixels[:, None], np.float32)
        refined = cv2.cornerSubPix(grey, start, (half, half), (-1, -1), _REFINE).reshape(4, 2)
        rows.append((int(number), refined.astype(np.float64)))
    if not rows:
        return none
    return TagView(np.array([n for n, _ in rows], np.int64), np.stack([c for _, c in rows]))
