"""Options that the jobs take by keyword, for editors and type checkers. Written by `tests/option_types.py`."""

from __future__ import annotations

from typing import Literal, TypedDict


class StereoKeywords(TypedDict, total=False):
    """Fields of `StereoConfig`, each optional."""

    min_disparity_px: int
    max_disparity_px: int | None
    search: Literal["full", "coarse_to_fine"]
    method: Literal["sgm", "block"]
    block_px: int
    paths: Literal[4, 8]
    window: tuple[int, int]
    brightness_cost: int
    small_penalty: int
    edge_penalty: float
    edge_fade: float
    left_right: Literal["accurate", "fast"]
    max_left_right_px: float
    min_margin: float
    max_sigma_px: float | None
    min_region_px: int
    median_px: Literal[0, 3, 5]
    uncalibrated: bool
    fill: bool
    max_frames: int
    cluster: str | None
    shared_folder: bool
