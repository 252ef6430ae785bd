"""Render the held-out views of a trained field within a time limit, and compare them with their images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np

from epipole._jit import compile_seconds
from epipole._parallel import num_threads
from epipole.fields.training_view import TrainingView
from epipole.io.images.rgba import write_png
from epipole.pipelines.fields.cameras import RenderView
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.page import rendered_names
from epipole.pipelines.fields.rendering.image_units import EXACT_IMAGE, UNITS, ViewPayload, unit_of_view
from epipole.pipelines.fields.rendering.renderer import (
    FieldFile,
    Rendering,
    in_bytes,
    opened_field,
    renderer_of,
)
from epipole.pipelines.fields.scores import scores_of
from epipole.runs import Connection, Run, Unit, load, run_units

Found = TypeVar("Found")

RENDER_FRACTION = 0.25
"""Fraction of the training time that rendering views may take afterwards; one view is always rendered."""
PROBED = 3
"""Held-out views that are rendered during training."""
RAYS_OF_THREAD = 2048
"""Pixels per thread of the small image that is timed, so that all threads are busy."""


@runtime_checkable
class Renderer(Protocol):
    """A field in training."""

    @property
    def background(self) -> np.ndarray:
        """(3,) background color."""

    def render_counted(self, view: TrainingView) -> tuple[np.ndarray, int]:
        """(h, w, 3) render of a view, and the number of evaluations."""


class Timed(NamedTuple):
    """A rendered view."""

    image: np.ndarray
    seconds: float
    """Without compilation."""
    num_evaluated: int


class WrittenField:
    """A field as stored in its file."""

    def __init__(self, file: Path, background: float) -> None:
        self.rendering = Rendering(FieldFile.now(file), background=background)

    @property
    def background(self) -> np.ndarray:
        """(3,) background color."""
        return np.full(3, self.rendering.background, np.float32)

    def render_counted(self, view: TrainingView) -> tuple[np.ndarray, int]:
        """(h, w, 3) render of a view, and the number of evaluations."""
        return renderer_of(self.rendering)(_as_render_view(view))


class Workers:
    """The machines of a cluster, which render views from the file of a field."""

    def __init__(self, connection: Connection, rendering: Rendering, root: Path) -> None:
        self.connection, self.rendering, self.folder = connection, rendering, root / UNITS
        self._units: dict[str, Unit] = {}

    @property
    def num_at_once(self) -> int:
        """Number of views that are rendered at the same time."""
        return max(1, self.connection.num_threads())

    def render(self, views: Sequence[TrainingView]) -> None:
        """Render some views."""
        payloads = [ViewPayload(self.rendering, _as_render_view(view), is_exact=True) for view in views]
        units = {payload.view.name: unit_of_view(self.folder, payload) for payload in payloads}
        run_units(list(units.values()), stage="test", executor=self.connection)
        self._units |= units

    def rendered(self, view: TrainingView) -> Timed:
        """A view that was rendered, which is returned once."""
        unit = self._units.pop(view.name)
        found = load(unit.path, EXACT_IMAGE)
        unit.path.unlink()
        with suppress(OSError):  # other views follow
            self.folder.rmdir()
        return Timed(found["image"], float(found["seconds"]), int(found["num_evaluated"]))


def _as_render_view(view: TrainingView) -> RenderView:
    return RenderView(view.name, view.camera, view.cam_from_world)


def seconds_of_view(renderer: Renderer, view: TrainingView) -> float:
    """Estimated time to render a view, from two downscaled ones, without compilation."""
    pixels = view.camera.width * view.camera.height
    most = min(view.camera.width, view.camera.height)
    factor = min(max(1, int((pixels / (RAYS_OF_THREAD * num_threads())) ** 0.5)), most)
    small, smaller = view.smaller(factor), view.smaller(min(2 * factor, most))
    timed(renderer, smaller)  # warms the caches
    (_, small_s, _), (_, smaller_s, _) = timed(renderer, small), timed(renderer, smaller)
    small_px, smaller_px = (each.camera.width * each.camera.height for each in (small, smaller))
    if small_px == smaller_px:
        return small_s * pixels / small_px
    pixel_s = max(0.0, small_s - smaller_s) / (small_px - smaller_px)
    return small_s + pixel_s * (pixels - small_px)


def timed(renderer: Renderer, view: TrainingView) -> Timed:
    """Render a view."""
    start, compiled = perf_counter(), compile_seconds()
    image, count = renderer.render_counted(view)
    return Timed(image, max(perf_counter() - start - (compile_seconds() - compiled), 1e-9), count)


def rows_of_two_passes(count: int) -> list[int]:
    """Order of rows such that every prefix is spread evenly: both ends, then midpoints of the gaps."""
    order, gaps = [0, count - 1][:count], [(0, count - 1)]
    while gaps:
        halved = [(low, (low + high) // 2, high) for low, high in gaps if high - low > 1]
        order += [middle for _, middle, _ in halved]
        gaps = [gap for low, middle, high in halved for gap in ((low, middle), (middle, high))]
    return order


def in_time(
    views: Sequence[TrainingView],
    wanted: FieldOptions,
    render: Callable[[TrainingView], Found],
    report: Callable[[int, int], None],
    warnings: list[str],
    workers: Workers | None = None,
) -> list[tuple[TrainingView, Found]]:
    """Render the views, or an evenly spaced subset that fits in a quarter of the training time; at least one.

    If the training has a number of steps instead of a time, all views are rendered.

    Args:
        views: views.
        wanted: options with the training time.
        render: called with each view.
        report: called with the number of views done and the number of all.
        warnings: gets a warning if not all views are rendered.
        workers: render as many views at once as there are workers, before `render` is called with each.
    """
    budget_s = np.inf if wanted.seconds is None else RENDER_FRACTION * wanted.seconds
    found: dict[int, Found] = {}
    spent_s = 0.0
    report(0, len(views))
    left = rows_of_two_passes(len(views))
    while left:
        rows = left[: 1 if workers is None else workers.num_at_once]
        if found and spent_s * (len(found) + len(rows)) / len(found) > budget_s:
            warnings.append(
                f"only {len(found)} of {len(views)} views were rendered and compared: a view takes about "
                f"{spent_s / len(found):.2g} s, and rendering may take {budget_s:.3g} s, a quarter of the training time. "
                "Train longer, reduce the image size (max_side_px), or pass steps instead of a time to compare more"
            )
            report(len(found), len(found))
            break
        start, compiled = perf_counter(), compile_seconds()
        if workers is not None:
            workers.render([views[row] for row in rows])
        found |= {row: render(views[row]) for row in rows}
        spent_s += perf_counter() - start - (compile_seconds() - compiled)
        left = left[len(rows) :]
        report(len(found), len(views))
    return [(views[row], found[row]) for row in sorted(found)]


def compared(
    renderer: Renderer,
    test: Sequence[TrainingView],
    wanted: FieldOptions,
    run: Run,
) -> list[dict[str, Any]]:
    """Render the held-out views into `test`, within the time limit, and compute their scores.

    If the run has a cluster, its workers render a `WrittenField`; Gaussians take milliseconds here.
    """
    files, workers, connection = rendered_names(test), None, run.job.executor
    if isinstance(renderer, WrittenField) and isinstance(connection, Connection):
        workers = Workers(connection, renderer.rendering, run.root)
    with run.stage("test"), run.folder.publish("test") as aside:

        def render(view: TrainingView) -> dict[str, Any]:
            rendered, seconds, count = timed(renderer, view) if workers is None else workers.rendered(view)
            write_png(aside / "test" / files[view.name], in_bytes(rendered))
            figures = {"name": view.name, **scores_of(rendered, view, renderer.background)}
            return {**figures, "render_s": seconds, "count": count}

        rows = in_time(test, wanted, render, partial(run.report, "test"), run.warnings, workers)
    opened_field.cache_clear()
    return [row for _, row in rows]


def probed(renderer: Renderer, test: Sequence[TrainingView], most_s: float) -> float | None:
    """Mean PSNR of a few held-out views; None if there are none or it would take longer than `most_s`."""
    views = [test[row] for row in rows_of_two_passes(len(test))[:PROBED]]
    if not views or most_s <= 0 or len(views) * seconds_of_view(renderer, views[0]) > most_s:
        return None
    start, scores = perf_counter(), list[float]()
    for view in views:
        if perf_counter() - start > most_s:
            return None
        scores.append(scores_of(renderer.render_counted(view)[0], view, renderer.background)["psnr"])
    return float(np.mean(scores))
