"""Render the held-out views of a trained field within a time limit, and compare them with their images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from time import perf_counter
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np

from epipole._jit import compile_seconds
from epipole._parallel import num_threads
from epipole.fields.training_view import TrainingView
from epipole.io.images.rgba import write_png
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.page import rendered_names
from epipole.pipelines.fields.scores import scores_of
from epipole.runs import Run

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


def timed(renderer: Renderer, view: TrainingView) -> tuple[np.ndarray, float, int]:
    """The image, the time in seconds without compilation, and the number of evaluations."""
    start, compiled = perf_counter(), compile_seconds()
    image, count = renderer.render_counted(view)
    return image, max(perf_counter() - start - (compile_seconds() - compiled), 1e-9), count


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
) -> list[tuple[TrainingView, Found]]:
    """Render the views, or an evenly spaced subset that fits in a quarter of the training time; at least one.

    If the training has a number of steps instead of a time, all views are rendered.

    Args:
        views: views.
        wanted: options with the training time.
        render: called with each view.
        report: called with the number of views done and the number of all.
        warnings: gets a warning if not all views are rendered.
    """
    budget_s = np.inf if wanted.seconds is None else RENDER_FRACTION * wanted.seconds
    found: dict[int, Found] = {}
    spent_s = 0.0
    report(0, len(views))
    for row in rows_of_two_passes(len(views)):
        if found and spent_s * (len(found) + 1) / len(found) > budget_s:
            warnings.append(
                f"only {len(found)} of {len(views)} views were rendered and compared: a view takes about "
                f"{spent_s / len(found):.2g} s, and rendering may take {budget_s:.3g} s, a quarter of the training time. "
                "Train longer, reduce the image size (max_side_px), or pass steps instead of a time to compare more"
            )
            report(len(found), len(found))
            break
        start, compiled = perf_counter(), compile_seconds()
        found[row] = render(views[row])
        spent_s += perf_counter() - start - (compile_seconds() - compiled)
        report(len(found), len(views))
    return [(views[row], found[row]) for row in sorted(found)]


def compared(
    renderer: Renderer, test: Sequence[TrainingView], wanted: FieldOptions, run: Run
) -> list[dict[str, Any]]:
    """Render the held-out views into `test`, within the time limit, and compute their scores."""
    files = rendered_names(test)
    with run.stage("test"), run.folder.publish("test") as aside:

        def render(view: TrainingView) -> dict[str, Any]:
            rendered, seconds, count = timed(renderer, view)
            write_png(
                aside / "test" / files[view.name], np.rint(255 * np.clip(rendered, 0, 1)).astype(np.uint8)
            )
            figures = {"name": view.name, **scores_of(rendered, view, renderer.background)}
            return {**figures, "render_s": seconds, "count": count}

        rows = in_time(test, wanted, render, partial(run.report, "test"), run.warnings)
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
