"""Options that the jobs take by keyword, for editors and type checkers. Written by `tests/option_types.py`."""

from __future__ import annotations

from pathlib import Path
from typing import TypedDict

from epipole.config import FeatureConfig, MatchConfig
from epipole.pipelines.localization.config import LocalizerConfig


class LocalizeKeywords(TypedDict, total=False):
    """Fields of `LocalizeConfig`, each optional."""

    camera_model: str | None
    camera_params: str | None
    calibration: str | Path | None
    include: tuple[str, ...]
    exclude: tuple[str, ...]
    masks: str | Path | None
    max_frames: int
    threads: int | None
    localizer: LocalizerConfig
    neighbors: int
    further_neighbors: int
    max_error_px: float
    search_px: float
    min_inliers: int
    min_ratio: float
    seed: int
    features: FeatureConfig
    matching: MatchConfig
