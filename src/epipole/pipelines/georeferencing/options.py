"""Options that the jobs take by keyword, for editors and type checkers. Written by `tests/option_types.py`."""

from __future__ import annotations

from pathlib import Path
from typing import TypedDict


class GeoreferenceKeywords(TypedDict, total=False):
    """Fields of `GeoreferenceConfig`, each optional."""

    gcp: str | Path | None
    check: tuple[str, ...]
    gcp_sigma_m: float
    gcp_height_sigma_m: float
    mark_sigma_px: float
    use_gps: bool
    gps_sigma_m: float
    refine_cameras: bool
    seed: int
    threads: int | None
