"""Objects of known size for synthetic scenes: AprilTags, ArUco markers and chessboards, as white sheets with black planes."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from epipole._checks import checked
from epipole.config import check_dictionary
from epipole.errors import ConfigError
from epipole.synthetic.scene import Plane, Primitive, Texture, Vector

_opencv: Any = cv2  # its stubs lack parts of aruco
WHITE, BLACK = (0.92, 0.92, 0.92), (0.04, 0.04, 0.04)
LIFT = 1e-4
"""Distance of the black planes in front of the sheet, in meters."""


@checked
def tag_sheet(
    number: int, side: float, center: Vector, right: Vector, down: Vector, dictionary: str = "APRILTAG_36h11"
) -> list[Primitive]:
    """A marker on a white sheet.

    Args:
        number: marker id.
        side: of the black square, in meters.
        center: of the sheet.
        right: unit direction to the right in the marker.
        down: unit direction down the marker, orthogonal to `right`; the marker is visible from the side where these hold.
        dictionary: OpenCV's name without DICT_.

    Raises:
        ConfigError: there is no such marker, or the side is not positive.
    """
    check_dictionary(dictionary)
    known = _opencv.aruco.getPredefinedDictionary(getattr(_opencv.aruco, f"DICT_{dictionary}"))
    if not 0 <= number < len(known.bytesList) or not 0 < side < np.inf:
        raise ConfigError(f"{dictionary} has no marker {number}, or side is not positive, got {side}")
    cells = int(known.markerSize) + 2
    pattern = _opencv.aruco.generateImageMarker(known, number, cells, borderBits=1) > 0
    return _sheet(pattern, side / cells, center, (right, down))


@checked
def chessboard_sheet(
    columns: int, rows: int, square: float, center: Vector, right: Vector, down: Vector
) -> list[Primitive]:
    """A chessboard with `columns` x `rows` inner corners on a white sheet.

    Args:
        columns: inner corners in a row.
        rows: inner corners in a column.
        square: side of a square, in meters.
        center: of the board.
        right: unit direction along its rows.
        down: unit direction along its columns, orthogonal to `right`.

    Raises:
        ConfigError: a number of corners is not 1 to 100, or the side is not positive.
    """
    if min(columns, rows) < 1 or max(columns, rows) > 100 or not 0 < square < np.inf:
        raise ConfigError(
            f"a chessboard needs 1 to 100 inner corners per side and a positive square size, got {columns} x {rows}"
        )
    down_row, right_row = np.indices((rows + 1, columns + 1))
    return _sheet((down_row + right_row) % 2 == 1, square, center, (right, down))


def _sheet(is_white: np.ndarray, cell: float, center: Vector, axes: tuple[Vector, Vector]) -> list[Primitive]:
    """Runs of black cells in front of a white sheet, which has a margin of one cell."""
    right, down = np.array(axes[0], np.float64), np.array(axes[1], np.float64)
    middle, toward = np.array(center, np.float64), -np.cross(right, down)
    height, width = is_white.shape
    half = (0.5 * cell * (width + 2), 0.5 * cell * (height + 2))
    out: list[Primitive] = [_plane(middle, right, down, half, WHITE)]
    for row in range(height):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], ~is_white[row], [False]]).astype(np.int8)))
        for first, last in zip(edges[::2], edges[1::2]):
            along = cell * (0.5 * (first + last) - 0.5 * width)
            across = cell * (row + 0.5 - 0.5 * height)
            at = middle + along * right + across * down + LIFT * toward
            out.append(_plane(at, right, down, (0.5 * cell * (last - first), 0.5 * cell), BLACK))
    return out


def _plane(
    center: np.ndarray, right: np.ndarray, down: np.ndarray, half: tuple[float, float], color: Vector
) -> Plane:
    x, y, z = (float(v) for v in center)
    return Plane(
        center=(x, y, z),
        direction_u=(float(right[0]), float(right[1]), float(right[2])),
        direction_v=(float(down[0]), float(down[1]), float(down[2])),
        half_size=(float(half[0]), float(half[1])),
        color=color,
        texture=Texture.PLAIN,
    )
