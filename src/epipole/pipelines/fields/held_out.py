"""Held-out views of a trained field: rendered, as many as the time allows, written and compared with their pictures."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Any, Protocol, runtime_checkable

import numpy as np

from epipole._jit import compile_seconds
from epipole._parallel import num_threads
from epipole.fields.training_view import TrainingView
from epipole.io.rgba_pictures import write_png
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.page import drawn_name
from epipole.pipelines.fields.scores import scores_of
from epipole.runs import Run

RENDER_SHARE = 0.25
"""Of the time of the training: rendering views afterwards takes no more, but for a single view."""
PROBED = 3
"""Held-out views that are rendered along the way."""
RAYS_OF_THREAD = 2048
"""Pixels, for each thread, of the small picture that shows how long a view takes: all threads have work."""


@runtime_checkable
class Renderer(Protocol):
    """A field that is being trained."""

    background: np.ndarray

    def draw_counted(self, view: TrainingView) -> tuple[np.ndarray, int]:
        """(h, w, 3) the picture of a view, and how often the field was asked for it."""


def seconds_of_view(renderer: Renderer, view: TrainingView) -> float:
    """About how long it takes to render a view, by one that is smaller; compilation is not counted."""
    pixels = view.camera.width * view.camera.height
    small = view.smaller(max(1, int((pixels / (RAYS_OF_THREAD * num_threads())) ** 0.5)))
    _, seconds, _ = timed(renderer, small)
    return seconds * pixels / (small.camera.width * small.camera.height)


def timed(renderer: Renderer, view: TrainingView) -> tuple[np.ndarray, float, int]:
    """The picture, the seconds without compilation, and how often the field was asked."""
    begin, compiled = perf_counter(), compile_seconds()
    picture, count = renderer.draw_counted(view)
    return picture, max(perf_counter() - begin - (compile_seconds() - compiled), 1e-9), count


def spread(count: int, of: int) -> list[int]:
    """At most so many rows of all, evenly spread."""
    return np.unique(np.linspace(0, of - 1, min(count, of)).round().astype(np.int64)).tolist() if of else []


def affordable(
    renderer: Renderer, views: Sequence[TrainingView], wanted: FieldOptions, warnings: list[str]
) -> list[TrainingView]:
    """The views, or those of them, spread over all, that can be rendered in a share of the training's time.

    A training of a number of steps has no time that could be kept: all its views are rendered.
    """
    if wanted.seconds is None or not views:
        return list(views)
    budget_s, each_s = RENDER_SHARE * wanted.seconds, seconds_of_view(renderer, views[len(views) // 2])
    rows = spread(max(1, int(budget_s / each_s)), len(views))
    if len(rows) < len(views):
        warnings.append(
            f"{len(rows)} of {len(views)} views are rendered and compared: a view takes about {each_s:.0f} s on this machine, "
            f"and rendering may take {budget_s:.0f} s, a quarter of the training's time (a longer time, a smaller "
            "max_side_px, or steps instead of a time compare more)"
        )
    return [views[row] for row in rows]


def compared(
    renderer: Renderer, test: Sequence[TrainingView], wanted: FieldOptions, run: Run
) -> list[dict[str, Any]]:
    """Render the held-out views into `test`, as many as the time allows, and say how like they are."""
    scores = []
    views = affordable(renderer, test, wanted, run.warnings)
    with run.stage("test"), run.folder.publish("test") as aside:
        run.report("test", 0, len(views))
        for n, view in enumerate(views):
            drawn, seconds, count = timed(renderer, view)
            write_png(
                aside / "test" / drawn_name(view.name), np.rint(255 * np.clip(drawn, 0, 1)).astype(np.uint8)
            )
            told = {"name": view.name, **scores_of(drawn, view, renderer.background)}
            scores.append({**told, "render_s": seconds, "count": count})
            run.report("test", n + 1, len(views))
    return scores


def probed(renderer: Renderer, test: Sequence[TrainingView], most_s: float) -> float | None:
    """Mean PSNR of some held-out views, spread over them; None where there are none, or it would take longer than that."""
    views = [test[row] for row in spread(PROBED, len(test))]
    if not views or most_s <= 0 or len(views) * seconds_of_view(renderer, views[0]) > most_s:
        return None
    begin, scores = perf_counter(), list[float]()
    for view in views:
        if perf_counter() - begin > most_s:
            return None
        scores.append(scores_of(renderer.draw_counted(view)[0], view, renderer.background)["psnr"])
    return float(np.mean(scores))
