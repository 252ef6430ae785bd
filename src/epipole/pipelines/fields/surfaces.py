"""Depth, coverage and color of any trained field, as seen by a camera."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from epipole.cameras import Camera
from epipole.fields.splat.rasterizer import RenderOptions
from epipole.fields.splat.rasterizer import render as render
from epipole.io.gaussians.files import gaussians_file, read_gaussians
from epipole.pipelines.fields.cameras import RenderView
from epipole.pipelines.fields.kinds import Kind, kind_in
from epipole.pipelines.fields.scene import SUMMARY, recorded_antialiased

LEAST_OPACITY = 0.1
"""Smallest opacity of Gaussians that define the extent of the scene."""
LEAST_COVERAGE = 0.5
"""Smallest coverage of pixels that show a surface."""


class Seen(NamedTuple):
    """Render of a field from a camera."""

    depth: np.ndarray
    """(h, w) along the optical axis, times coverage."""
    coverage: np.ndarray
    """(h, w)"""
    color: np.ndarray
    """(h, w, 3) color times coverage."""

    def surface(self) -> np.ndarray:
        """(h, w) depth, NaN where the coverage is too small."""
        shown = self.coverage > LEAST_COVERAGE
        return np.where(shown, self.depth / np.maximum(self.coverage, LEAST_COVERAGE), np.nan)


class StoredField(NamedTuple):
    """A trained field and its file."""

    kind: Kind | None
    """None: Gaussians."""
    content: Any
    file: Path


def field_at(source: Path) -> StoredField:
    """The field in an output folder or a file.

    Raises:
        FileFormatError: the field cannot be read.
    """
    found = kind_in(source)
    if found is not None:
        kind, file = found
        return StoredField(kind, kind.read(file), file)
    file = gaussians_file(source)
    return StoredField(None, read_gaussians(file), file)


def seen_from(source: Path) -> tuple[Callable[[RenderView], Seen], np.ndarray]:
    """Function that renders a view, and positions (n, 3) that define the extent of the scene.

    Raises:
        FileFormatError: the field cannot be read.
    """
    field = field_at(source)
    see = surface_of(field, antialiased=recorded_antialiased(field.file.with_name(SUMMARY)))
    if field.kind is not None:
        return see, field.kind.positions(field.content)
    opacity = 1.0 / (1.0 + np.exp(-field.content.opacity_logits))
    positions = field.content.centers_in_world[opacity >= LEAST_OPACITY]
    return see, positions if len(positions) else field.content.centers_in_world


def surface_of(field: StoredField, *, antialiased: bool) -> Callable[[RenderView], Seen]:
    """Function that renders a view; `antialiased` applies to Gaussians."""
    kind, content = field.kind, field.content
    if kind is not None:
        return lambda render_view: _marched(kind, content, render_view)
    options = RenderOptions(antialiased=antialiased)

    def splatted(render_view: RenderView) -> Seen:
        rendered = render(content, render_view.camera, render_view.cam_from_world, options)
        return Seen(rendered.depth, rendered.coverage, rendered.color)

    return splatted


def _marched(kind: Kind, field: Any, render_view: RenderView) -> Seen:
    """Render over black and white, whose difference is the transmittance; converts depth along rays to z-depth."""
    black, depth, _ = kind.render(
        field, render_view.camera, render_view.cam_from_world, np.zeros(3, np.float32)
    )
    white = kind.render(field, render_view.camera, render_view.cam_from_world, np.ones(3, np.float32))[0]
    return Seen(depth * _along_axis(render_view.camera), 1.0 - (white - black).mean(axis=2), black)


def _along_axis(camera: Camera) -> np.ndarray:
    """(h, w) ratio of z-depth to depth along the ray of each pixel."""
    matrix = camera.K
    v, u = np.mgrid[: camera.height, : camera.width]
    x, y = (u - matrix[0, 2]) / matrix[0, 0], (v - matrix[1, 2]) / matrix[1, 1]
    return np.asarray(1.0 / np.sqrt(x * x + y * y + 1.0), np.float32)
