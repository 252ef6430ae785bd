"""Corners found in drawn boards lie where the drawing puts them."""

import cv2
import numpy as np
import pytest

from epipole.config import BoardConfig
from epipole.errors import ConfigError
from epipole.features.boards import corners_on_board, find_board, whole_chessboard

UNIT = 60  # pixels of a square in the drawing
BOARDS = [
    BoardConfig(columns=9, rows=6, square=1.0),
    BoardConfig(kind="charuco", columns=8, rows=6, square=1.0),
    BoardConfig(kind="apriltag", columns=4, rows=3, square=1.0, spacing=0.5),
]


def rendered(board):
    """The board printed flat, and the pixel of the point (0, 0) of `corners_on_board`."""
    if board.kind == "chessboard":
        squares = np.add.outer(np.arange(board.rows + 1), np.arange(board.columns + 1)) % 2
        flat = np.kron(255 * squares, np.ones((UNIT, UNIT))).astype(np.uint8)
        flat = cv2.copyMakeBorder(flat, UNIT, UNIT, UNIT, UNIT, cv2.BORDER_CONSTANT, value=255)
        return flat, 2 * UNIT - 0.5
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary_name}"))
    size = (board.columns, board.rows)
    if board.kind == "charuco":
        printed = cv2.aruco.CharucoBoard(size, 1.0, board.marker_ratio, dictionary)
        flat = printed.generateImage((UNIT * board.columns, UNIT * board.rows))
    else:
        printed = cv2.aruco.GridBoard(size, 1.0, board.spacing, dictionary)
        pitch = 1.0 + board.spacing
        wide, high = board.columns * pitch - board.spacing, board.rows * pitch - board.spacing
        flat = printed.generateImage((round(UNIT * wide), round(UNIT * high)))
    return cv2.copyMakeBorder(flat, UNIT, UNIT, UNIT, UNIT, cv2.BORDER_CONSTANT, value=255), UNIT - 0.5


@pytest.mark.parametrize("board", BOARDS, ids=lambda b: b.kind)
def test_corners_of_a_board_seen_askew(board):
    flat, origin = rendered(board)
    height, width = flat.shape
    askew = cv2.getPerspectiveTransform(
        np.float32([[0, 0], [width, 0], [width, height], [0, height]]),
        np.float32([[60, 40], [width - 30, 70], [width - 50, height - 20], [30, height - 60]]),
    )
    big = cv2.warpPerspective(flat, askew, (width, height), flags=cv2.INTER_AREA, borderValue=255)
    found = find_board(cv2.GaussianBlur(big, (0, 0), 0.8), board)
    points = corners_on_board(board)
    assert len(found) == len(points)
    plane = points[found.corner, :2] * UNIT + origin
    truth = cv2.perspectiveTransform(plane[None], askew)[0]
    if board.kind == "chessboard" and np.abs(truth - found.pixels).max() > UNIT:
        truth = truth[::-1]  # a chessboard may be counted from either end
    assert np.median(np.linalg.norm(found.pixels - truth, axis=1)) < 0.35
    assert np.abs(found.pixels - truth).max() < 1.5


def test_kalibrs_grids_are_numbered_from_the_bottom():
    board = BOARDS[2]
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    pitch = round(UNIT * 1.5)
    flat = np.full((3 * pitch + 2 * UNIT, 4 * pitch + 2 * UNIT), 255, np.uint8)
    for tag in range(12):
        row, column = 2 - tag // 4, tag % 4
        y, x = UNIT + row * pitch, UNIT + column * pitch
        flat[y : y + UNIT, x : x + UNIT] = cv2.aruco.generateImageMarker(dictionary, tag, UNIT)
    found = find_board(cv2.GaussianBlur(cv2.resize(flat, None, fx=2, fy=2), (0, 0), 1.0), board)
    assert len(found) == 48
    matrix, _ = cv2.findHomography(corners_on_board(board)[found.corner, :2], found.pixels)
    moved = cv2.perspectiveTransform(corners_on_board(board)[found.corner, :2][None], matrix)[0]
    assert np.abs(moved - found.pixels).max() < 1.5


def test_a_board_larger_than_was_said_is_noticed(data_dir):
    flat, _ = rendered(BOARDS[0])
    blank = np.full_like(flat, 128)
    for size in ((8, 6), (9, 5), (7, 5)):
        assert whole_chessboard([flat, blank, flat], BoardConfig(columns=size[0], rows=size[1])) == (9, 6)
    assert whole_chessboard([flat, blank, blank], BoardConfig(columns=8, rows=6)) is None
    folder = data_dir / "calibration" / "opencv_stereo"
    real = [cv2.imread(str(folder / f"left{k:02d}.jpg"), cv2.IMREAD_GRAYSCALE) for k in range(1, 9)]
    assert whole_chessboard(real, BOARDS[0]) is None
    for size in ((8, 6), (9, 5), (7, 6)):
        assert whole_chessboard(real, BoardConfig(columns=size[0], rows=size[1])) == (9, 6)
    assert whole_chessboard([flat, flat], BOARDS[0]) is None
    assert whole_chessboard([], BOARDS[0]) is None


def test_nothing_is_found_where_nothing_is(rng):
    noise = rng.integers(0, 255, (240, 320), dtype=np.uint8)
    for board in BOARDS:
        for image in (np.zeros((240, 320), np.uint8), noise, np.zeros((3, 3), np.uint8)):
            assert len(find_board(image, board)) == 0


def test_boards_that_cannot_be():
    for options in ({"columns": 2}, {"square": 0.0}, {"square": np.nan}, {"dictionary": "9X9_50"}):
        with pytest.raises(ConfigError):
            BoardConfig(**options)
    with pytest.raises(ConfigError, match="marker_ratio"):
        BoardConfig(kind="charuco", marker_ratio=1.2)
