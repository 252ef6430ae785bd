"""Calibration boards: corner positions and detection."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8

from epipole.config import BoardConfig

_opencv: Any = cv2  # its stubs lack parts of aruco
_LEAST_CORNERS = 6
_LEAST_LARGER = 2  # images
_LEAST_SIDE = 64  # pixels: smaller images are skipped
_WINDOW_FRACTION = 0.4  # half window over smallest corner distance: the best of 0.15 to 0.5 on real pairs
_REFINE = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-4)


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """Corners of the board detected in one image."""

    corner: Int64[np.ndarray, " n"]
    """Rows in `corners_on_board`."""
    pixels: Float64[np.ndarray, "n 2"]

    def __len__(self) -> int:
        return len(self.corner)

    def __repr__(self) -> str:
        return f"BoardView({len(self)} corners)"


def corners_on_board(board: BoardConfig) -> Float64[np.ndarray, "n 3"]:
    """All corners on the plane z = 0, x along the rows, y down, in units of `square`.

    Chessboards and ChArUco: the inner corners row by row. AprilTag grids: four corners per tag, tag by tag, clockwise
    from the tag's top left in its printed orientation, row by row from the top.
    """
    plane: np.ndarray
    if board.kind == "apriltag":
        pitch = board.square * (1.0 + board.spacing)
        u, v = np.meshgrid(np.arange(board.columns), np.arange(board.rows))
        first = pitch * np.stack([u.ravel(), v.ravel()], axis=1)
        around = board.square * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        plane = (first[:, None] + around).reshape(-1, 2)
    else:
        less = 0 if board.kind == "chessboard" else 1
        u, v = np.meshgrid(np.arange(board.columns - less), np.arange(board.rows - less))
        plane = board.square * np.stack([u.ravel(), v.ravel()], axis=1)
        if board.kind == "charuco":
            plane = plane + board.square
    return np.concatenate([plane, np.zeros((len(plane), 1))], axis=1)


def find_board(gray: UInt8[np.ndarray, "h w"], board: BoardConfig) -> BoardView:
    """The corners that OpenCV detects; empty if there is no board."""
    if min(gray.shape) < _LEAST_SIDE:
        return _nothing()
    cv2.setRNGSeed(0)  # OpenCV's detectors are randomized: results must not depend on earlier images
    find = {"chessboard": _find_chessboard, "charuco": _find_charuco, "apriltag": _find_tags}
    found = find[board.kind](np.ascontiguousarray(gray), board)
    return found if len(found) >= _LEAST_CORNERS else _nothing()


def _nothing() -> BoardView:
    return BoardView(np.zeros(0, np.int64), np.zeros((0, 2)))


def _find_chessboard(gray: np.ndarray, board: BoardConfig) -> BoardView:
    """All corners or none, as the corners of a partially visible chessboard cannot be identified.

    Corners are refined in windows: larger ones average more noise, but are biased if they reach the next corner.
    """
    size = (board.columns, board.rows)
    found, pixels = cv2.findChessboardCorners(
        gray, size, flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    )
    if not found:
        found, pixels = cv2.findChessboardCornersSB(gray, size, flags=cv2.CALIB_CB_EXHAUSTIVE)
    if not found:
        return _nothing()
    grid = pixels.reshape(board.rows, board.columns, 2)
    gaps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
    half = int(np.clip(_WINDOW_FRACTION * min(gaps) - 1, 2, 11))
    refined = cv2.cornerSubPix(
        gray, np.ascontiguousarray(pixels, np.float32), (half, half), (-1, -1), _REFINE
    )
    return BoardView(np.arange(board.columns * board.rows), refined.reshape(-1, 2).astype(np.float64))


def whole_chessboard(
    images: Iterable[UInt8[np.ndarray, "h w"]], board: BoardConfig
) -> tuple[int, int] | None:
    """Columns and rows of inner corners that the images show, if the board is larger than stated.

    OpenCV's detector of larger boards sometimes finds an extra row or nothing at all. One image with the stated size is
    enough to confirm it; otherwise at least two images must show a larger one. The most frequent size wins, the smallest
    of equally frequent ones.
    """
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    seen: list[tuple[int, int]] = []
    for gray in images:
        cv2.setRNGSeed(0)  # as in find_board
        found, _, meta = cv2.findChessboardCornersSBWithMeta(gray, (board.columns, board.rows), flags)
        if not found or meta is None:
            continue
        rows, columns = sorted(meta.shape) if board.columns >= board.rows else sorted(meta.shape)[::-1]
        if (columns, rows) == (board.columns, board.rows):
            return None
        seen.append((columns, rows))
    if len(seen) < _LEAST_LARGER:
        return None
    return max(sorted(set(seen)), key=seen.count)


def _find_charuco(gray: np.ndarray, board: BoardConfig) -> BoardView:
    dictionary = _dictionary(board.dictionary_name)
    best = _nothing()
    for legacy in (False, True):  # boards made by OpenCV before 4.6 start with the other color
        printed = _opencv.aruco.CharucoBoard((board.columns, board.rows), 1.0, board.marker_ratio, dictionary)
        printed.setLegacyPattern(legacy)
        pixels, ids, _, _ = _opencv.aruco.CharucoDetector(printed).detectBoard(gray)
        if ids is not None and len(ids) > len(best):
            best = BoardView(ids.ravel().astype(np.int64), pixels.reshape(-1, 2).astype(np.float64))
    return best


def _find_tags(gray: np.ndarray, board: BoardConfig) -> BoardView:
    """Tags with a border of one or (Kalibr) two bits, numbered from the top or (Kalibr) the bottom row."""
    best: tuple[Any, Any] = ((), np.zeros(0, np.int64))
    for border in (1, 2):
        parameters = _opencv.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = _opencv.aruco.CORNER_REFINE_SUBPIX
        parameters.markerBorderBits = border
        corners, ids, _ = _opencv.aruco.ArucoDetector(
            _dictionary(board.dictionary_name), parameters
        ).detectMarkers(gray)
        if ids is not None and len(ids) > len(best[1]):
            best = (corners, ids.ravel().astype(np.int64))
    corners, ids = best
    known = ids < board.columns * board.rows
    if known.sum() < 2:
        return _nothing()
    ids, pixels = ids[known], np.stack([c.reshape(4, 2) for c in corners])[known].astype(np.float64)
    row, column = np.divmod(ids, board.columns)
    plane = corners_on_board(board)[:, :2].reshape(-1, 4, 2)
    choices = [ids, (board.rows - 1 - row) * board.columns + column]
    errors = [_plane_error(plane[tags].reshape(-1, 2), pixels.reshape(-1, 2)) for tags in choices]
    tags = choices[int(np.argmin(errors))]
    return BoardView((4 * tags[:, None] + np.arange(4)).ravel(), pixels.reshape(-1, 2))


def _plane_error(plane: np.ndarray, pixels: np.ndarray) -> float:
    """Median distance to the best homography: large for a wrong grid layout."""
    matrix, _ = cv2.findHomography(plane, pixels)
    if matrix is None:
        return np.inf
    moved = cv2.perspectiveTransform(plane[None], matrix)[0]
    return float(np.median(np.linalg.norm(moved - pixels, axis=1)))


def _dictionary(name: str) -> Any:
    return _opencv.aruco.getPredefinedDictionary(getattr(_opencv.aruco, f"DICT_{name}"))
