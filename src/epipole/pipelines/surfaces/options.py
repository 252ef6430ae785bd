"""Options that the jobs take by keyword, for editors and type checkers. Written by `tests/option_types.py`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, TypedDict


class SurfaceKeywords(TypedDict, total=False):
    """Fields of `SurfaceConfig`, each optional."""

    until: Literal["depth", "cloud", "mesh", "texture", "survey"]
    max_size_px: int
    sources: int
    images: str | Path | None
    masks: str | Path | None
    voxel: float | None
    min_component: float
    close: float
    faces: int | None
    texture_px: int
    formats: tuple[Literal["glb", "obj", "ply", "usdz"], ...]
    laz: bool
    resolution_m: float | None
    crs: str | None
    crop: tuple[float, float, float, float] | None
    contour_m: float | None
    cluster: str | None
    shared_folder: bool
    threads: int | None
