"""Options that the jobs take by keyword, for editors and type checkers. Written by `tests/option_types.py`."""

from __future__ import annotations

from typing import Literal, TypedDict

from epipole.config import BoardConfig


class CalibrationKeywords(TypedDict, total=False):
    """Fields of `CalibrationConfig`, each optional."""

    board: BoardConfig
    model: Literal["PINHOLE", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"]
    refine_warp: bool
    outlier_factor: float
    max_view_factor: float
    kind: Literal["chessboard", "charuco", "apriltag"]
    columns: int
    rows: int
    square: float
    marker_ratio: float
    spacing: float
    dictionary: str
