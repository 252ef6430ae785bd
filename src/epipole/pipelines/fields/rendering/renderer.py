"""What is rendered of a stored field: a small value, with which any process that sees the field's file renders the same images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np

from epipole.fields.normals import normals_of
from epipole.fields.splat.rasterizer import RenderOptions
from epipole.fields.splat.rasterizer import render as rasterize
from epipole.image import color_map
from epipole.pipelines.fields.cameras import RenderView
from epipole.pipelines.fields.surfaces import StoredField, field_at, surface_of
from epipole.runs.payloads import files_in

FileStates = tuple[tuple[int, int], ...]
"""Size and time of the last change, in nanoseconds, of each file."""


@dataclass(frozen=True, slots=True)
class FieldFile:
    """The file of a trained field, in a state."""

    path: Path
    """The folder, if it is an unpacked SOG."""
    states: FileStates

    @classmethod
    def now(cls, path: Path) -> FieldFile:
        """The present state of a file."""
        found = [file.stat() for file in files_in(path)]
        return cls(path, tuple((state.st_size, state.st_mtime_ns) for state in found))


@dataclass(frozen=True, slots=True)
class Rendering:
    """A field, and what is rendered of it."""

    field: FieldFile
    output: Literal["color", "depth", "normals", "coverage"] = "color"
    background: float = 0.0
    """Gray value from 0 to 1, behind colors."""
    antialiased: bool = False
    """Whether Gaussians are rendered with Mip-Splatting's filter."""
    limits: tuple[float, float] = (0.0, 1.0)
    """Depths of the first and last color."""


def in_bytes(rgb: np.ndarray) -> np.ndarray:
    """Colors from 0 to 1 as bytes."""
    return np.rint(255 * np.clip(rgb, 0, 1)).astype(np.uint8)


@lru_cache(maxsize=1)
def opened_field(file: FieldFile) -> StoredField:
    """The field of a file, which is read once for all views.

    Raises:
        FileFormatError: the field cannot be read.
    """
    return field_at(file.path)


def renderer_of(rendering: Rendering) -> Callable[[RenderView], tuple[np.ndarray, int]]:
    """Function that renders a view: (h, w, 3) colors from 0 to 1, and the number of evaluations if the output is color.

    Raises:
        FileFormatError: the field cannot be read.
    """
    field = opened_field(rendering.field)
    if rendering.output != "color":
        render = _surface_renderer(field, rendering)
        return lambda view: (render(view), 0)
    kind, content, behind = field.kind, field.content, np.full(3, rendering.background, np.float32)
    options = RenderOptions(antialiased=rendering.antialiased)

    def marched(view: RenderView) -> tuple[np.ndarray, int]:
        assert kind is not None
        image, _, count = kind.render(content, view.camera, view.cam_from_world, behind)
        return image, count

    def splatted(view: RenderView) -> tuple[np.ndarray, int]:
        rendered = rasterize(content, view.camera, view.cam_from_world, options)
        return rendered.over(behind), rendered.num_evaluated

    return splatted if kind is None else marched


def _surface_renderer(field: StoredField, rendering: Rendering) -> Callable[[RenderView], np.ndarray]:
    """Function that renders depth, normals or coverage of a view."""
    see = surface_of(field, antialiased=rendering.antialiased)

    def depth(view: RenderView) -> np.ndarray:
        return color_map(see(view).surface(), rendering.limits) / np.float32(255.0)

    def normals(view: RenderView) -> np.ndarray:
        return np.nan_to_num(0.5 + 0.5 * normals_of(see(view).surface(), view.camera))

    def coverage(view: RenderView) -> np.ndarray:
        return np.repeat(see(view).coverage[..., None], 3, axis=2)

    return {"depth": depth, "normals": normals, "coverage": coverage}[rendering.output]
