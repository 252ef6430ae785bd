"""Square fiducial markers: AprilTags and ArUco."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8

from epipole.config import check_dictionary

_opencv: Any = cv2  # its stubs lack parts of aruco
_LEAST_SIDE_PX = 14.0
"""Smallest side of a marker: below it the edges cannot be separated."""
_LEAST_IMAGE = 32
_ROUNDS = 3  # of edge fitting
_STEP_PX = 0.25  # sampling distance across an edge
_MARGIN = 0.15  # fraction of an edge's length left out at each corner
_CELL_FRACTION = (
    0.65  # half width of the search across an edge, in cells: the white margin ends after one cell
)
_HALF_PX = (1.0, 4.0)  # limits of that half width
_FURTHEST_PX = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class TagView:
    """Markers detected in one image."""

    number: Int64[np.ndarray, " n"]
    corners: Float64[np.ndarray, "n 4 2"]
    """Corners of the black square, clockwise from the marker's top left in its printed orientation."""

    def __len__(self) -> int:
        return len(self.number)

    def __repr__(self) -> str:
        return f"TagView({len(self)} markers)"


def find_tags(gray: UInt8[np.ndarray, "h w"], dictionary: str) -> TagView:
    """The markers that OpenCV detects; numbers that occur twice in the image are dropped.

    Args:
        gray: the image.
        dictionary: OpenCV's name without DICT_, such as APRILTAG_36h11 or 4X4_50.

    Raises:
        ConfigError: the dictionary is unknown.
    """
    check_dictionary(dictionary)
    none = TagView(np.zeros(0, np.int64), np.zeros((0, 4, 2)))
    if min(gray.shape) < _LEAST_IMAGE:
        return none
    gray = np.ascontiguousarray(gray)
    known = _opencv.aruco.getPredefinedDictionary(getattr(_opencv.aruco, f"DICT_{dictionary}"))
    corners, ids, _ = _opencv.aruco.ArucoDetector(known, _opencv.aruco.DetectorParameters()).detectMarkers(
        gray
    )
    if ids is None:
        return none
    numbers, counts = np.unique(ids.ravel(), return_counts=True)
    single, levels = numbers[counts == 1], gray.astype(np.float32)
    found = {int(n): c.reshape(4, 2).astype(np.float64) for n, c in zip(ids.ravel(), corners)}
    rows = []
    for number in single:
        pixels = found[int(number)]
        side = _narrowest(pixels)
        if side < _LEAST_SIDE_PX:
            continue
        refined = _by_edges(levels, pixels, side / (int(known.markerSize) + 2))
        if refined is not None:
            rows.append((int(number), refined))
    if not rows:
        return none
    return TagView(np.array([n for n, _ in rows], np.int64), np.stack([c for _, c in rows]))


def _narrowest(corners: np.ndarray) -> float:
    """The smallest distance of an opposite corner from an edge, in pixels."""
    along = np.roll(corners, -1, axis=0) - corners
    normal = (
        np.stack([along[:, 1], -along[:, 0]], axis=1)
        / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    )
    away = [abs(normal[k] @ (corners[(k + n) % 4] - corners[k])) for k in range(4) for n in (2, 3)]
    return float(min(away))


def _by_edges(gray: np.ndarray, corners: np.ndarray, cell_px: float) -> np.ndarray | None:
    """(4, 2) corners from the intersection of lines fitted to the four edges; None if an edge is missing.

    An edge is where the gray value changes most: the mean of the derivative across it. Symmetric blur does not move it,
    whereas it shifts a directly detected corner into the marker.
    """
    found, half = corners, float(np.clip(_CELL_FRACTION * cell_px, *_HALF_PX))
    for _ in range(_ROUNDS):
        edges = (_edge(gray, found[k], found[(k + 1) % 4], half) for k in range(4))
        lines = [line for line in edges if line is not None]
        if len(lines) < 4:
            return None
        meets = [np.cross(lines[k - 1], lines[k]) for k in range(4)]
        if any(abs(m[2]) < 1e-9 for m in meets):
            return None
        found = np.stack([m[:2] / m[2] for m in meets])
    return found if np.linalg.norm(found - corners, axis=1).max() <= _FURTHEST_PX else None


def _edge(gray: np.ndarray, start: np.ndarray, stop: np.ndarray, half: float) -> np.ndarray | None:
    """The line a x + b y + c = 0 through a dark-to-bright edge, sampled across at many positions."""
    length = float(np.linalg.norm(stop - start))
    if length < 4.0:
        return None
    along = (stop - start) / length
    across = np.array([along[1], -along[0]])  # outward, as corners are clockwise
    t = np.linspace(_MARGIN, 1.0 - _MARGIN, max(8, int(2 * length)))[:, None]
    steps = np.arange(-half, half + 1e-9, _STEP_PX)
    at = (start + t * (stop - start))[:, None] + steps[:, None] * across
    values = _opencv.remap(
        gray, at.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    rise = np.diff(values, axis=1).astype(np.float64)
    middle = 0.5 * (steps[1:] + steps[:-1])
    weight = np.maximum(rise, 0.0)
    total = weight.sum(axis=1)
    good = total > 0.5 * float(np.median(total))
    if good.sum() < 4 or not np.median(total) > 5.0:
        return None
    position = (weight @ middle)[good] / total[good]
    points = (start + t * (stop - start))[good] + position[:, None] * across
    near = np.abs(position - np.median(position)) <= 1.0
    points = points[near]
    if len(points) < 4:
        return None
    mean = points.mean(axis=0)
    normal = np.linalg.svd(points - mean)[2][1]
    return np.array([normal[0], normal[1], -float(normal @ mean)])
