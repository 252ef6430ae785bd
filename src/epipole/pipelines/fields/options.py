"""Options that the jobs take by keyword, for editors and type checkers. Written by `tests/option_types.py`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, TypedDict

from epipole.pipelines.fields.config import Background


class SplatKeywords(TypedDict, total=False):
    """Fields of `SplatConfig`, each optional."""

    time: str | None
    steps: int | None
    test_every: int
    test: str | None
    max_side_px: int
    background: Background
    masks: str | Path | None
    cluster: str | None
    shared_folder: bool
    view: bool
    port: int | None
    host: str
    max_gaussians: int | None
    memory_gb: float | None
    sh_degree: int
    ssim_weight: float
    antialiased: bool
    start: Literal["points", "dense", "random"]
    start_from: str | Path | None
    exposure: bool
    refine_poses: bool
    depth_weight: float
    seed: int


class NerfKeywords(TypedDict, total=False):
    """Fields of `NerfConfig`, each optional."""

    time: str | None
    steps: int | None
    test_every: int
    test: str | None
    max_side_px: int
    background: Background
    masks: str | Path | None
    cluster: str | None
    shared_folder: bool
    view: bool
    port: int | None
    host: str
    kind: Literal["grid", "hash"]
    seed: int


class RenderKeywords(TypedDict, total=False):
    """Fields of `RenderConfig`, each optional."""

    cameras: str | Path | None
    path: Literal["auto", "cameras", "orbit"]
    frames: int
    rotation_deg: float
    width: int | None
    height: int | None
    fov_deg: float
    fps: float
    background: Background
    antialiased: bool | None
    output: Literal["color", "depth", "normals", "coverage"]
    cluster: str | None
    shared_folder: bool


class MeshKeywords(TypedDict, total=False):
    """Fields of `MeshConfig`, each optional."""

    cameras: str | Path | None
    voxels: int
    max_views: int
    box_fraction: float
    box: tuple[float, float, float, float, float, float] | None
    min_component: float
    width: int | None
