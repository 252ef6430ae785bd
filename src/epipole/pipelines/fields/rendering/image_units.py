"""Images of a stored field as units of work, which other threads or the machines of a cluster render."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np

from epipole._checks.tables import Arrays, Expected, Table
from epipole._jit import compile_seconds
from epipole.pipelines.fields.cameras import RenderView
from epipole.pipelines.fields.rendering.renderer import Rendering, in_bytes, renderer_of
from epipole.runs import Unit, digest

UNITS = "units"
"""Folder of the results that are not yet written as images."""
FORMAT = 1
"""Increase when the images of the same field change."""
IMAGE: Table = {
    "image": Expected("uint8", "height width 3"),
    "num_evaluated": Expected("int64"),
    "seconds": Expected("float64"),
}
EXACT_IMAGE: Table = {**IMAGE, "image": Expected("float32", "height width 3")}


@dataclass(frozen=True, slots=True, eq=False)
class ViewPayload:
    """Input of the unit of one image."""

    rendering: Rendering
    view: RenderView
    is_exact: bool = False
    """Whether the image has single precision instead of bytes, to be compared with a photograph."""


def unit_of_view(folder: Path, payload: ViewPayload) -> Unit:
    """The unit of an image; its key covers the name of the view, as several may have the same pose."""
    rendering, view = payload.rendering, payload.view
    camera = view.camera
    key = digest(
        "render",
        FORMAT,
        [
            rendering.field.states,
            rendering.output,
            rendering.background,
            rendering.antialiased,
            rendering.limits,
        ],
        [view.name, camera.model.name, camera.width, camera.height, camera.params.tolist()],
        view.cam_from_world.as_matrix(),
        payload.is_exact,
    )
    return Unit(folder / f"{key}.npz", key, rendered_view, payload)


def rendered_view(payload: ViewPayload) -> Arrays:
    """Render an image; arrays as in `IMAGE` or `EXACT_IMAGE`, the time without compilation."""
    render = renderer_of(payload.rendering)
    start, compiled = perf_counter(), compile_seconds()
    image, count = render(payload.view)
    seconds = perf_counter() - start - (compile_seconds() - compiled)
    return {
        "image": np.asarray(image, np.float32) if payload.is_exact else in_bytes(image),
        "num_evaluated": np.array(count, np.int64),
        "seconds": np.array(seconds),
    }
