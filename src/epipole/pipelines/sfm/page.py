"""What the report of a reconstruction shows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from epipole._jit import compile_seconds
from epipole._version import __version__
from epipole.pipelines.sfm.pipeline import Solution
from epipole.report import ImageRow, ReportContent, render_report
from epipole.runs import Run, load
from epipole.scene import Reconstruction

MAX_INLIERS_SHOWN = 400


def render_page(solution: Solution, reasons: Mapping[str, str], run: Run, settings: dict[str, Any]) -> str:
    """The report as one HTML page."""
    return render_report(page_content(solution, reasons, run, settings))


def page_content(
    solution: Solution, reasons: Mapping[str, str], run: Run, settings: dict[str, Any]
) -> ReportContent:
    """What the report tells, gathered."""
    models, images = solution.mapped.models, solution.images
    model = models[0]
    component = np.full(len(images), -1)
    for number in reversed(range(len(models))):
        component[models[number].is_registered()] = number
    rows, thumbnails, inliers = [], {}, {}
    per_model = [(_observations_per_image(m)) for m in models]
    for i, name in enumerate(images.names):
        shown = max(int(component[i]), 0)
        counts, errors = per_model[shown]
        placed = bool(component[i] >= 0)
        rows.append(
            ImageRow(
                name,
                placed,
                int(component[i]),
                len(solution.keypoints[i]),
                int(counts[i]) if placed else 0,
                float(errors[i]) if placed else float("nan"),
                "" if placed else reasons.get(name, ""),
            )
        )
        thumbnails[name] = load(solution.features[i].path, "thumbnail")["thumbnail"].tobytes()
        camera = model.cameras[int(model.camera_of_image[i])]
        own = models[shown].tracks.keypoint[models[shown].tracks.image == i]
        pixels = model.images.keypoints_of(i)[np.sort(own)[:: max(1, len(own) // MAX_INLIERS_SHOWN)]]
        inliers[name] = (pixels + 0.5) / [camera.width, camera.height]
    rows += [ImageRow(n, False, -1, 0, 0, float("nan"), why) for n, why in images.left_out.items()]
    residuals = solution.mapped.gps_residuals_m[0]
    scale_note = "unknown scale: pictures alone cannot tell"
    if residuals is not None:
        scale_note = f"metres from GPS (median distance of the cameras from their fixes {np.nanmedian(residuals):.2f} m)"
    sources = images.focal_sources
    return ReportContent(
        title=images.folder.name or str(images.folder),
        reconstruction=model,
        view_graph=solution.view_graph,
        image_rows=tuple(rows),
        other_components=tuple(int(m.is_registered().sum()) for m in models[1:]),
        camera_lines=tuple(
            f"{model.cameras[c]!r}; focal length first: {sources[c]}" for c in range(len(sources))
        ),
        timings=dict(run.timings_s),
        compile_seconds=compile_seconds(),
        warnings=tuple(run.warnings),
        settings=settings,
        version=__version__,
        thumbnails=thumbnails,
        inliers=inliers,
        scale_note=scale_note,
        is_metric=residuals is not None,
    )


def _observations_per_image(model: Reconstruction) -> tuple[np.ndarray, np.ndarray]:
    n = len(model.images)
    counts = np.bincount(model.tracks.image, minlength=n)
    sums = np.bincount(model.tracks.image, model.reprojection_errors_px(), n)
    return counts, np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
