"""The job: photographs or a video to models, points, a database and a report in one folder."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from epipole._checks import as_path
from epipole._jit import compile_seconds
from epipole.config import options_of
from epipole.errors import NoModelError
from epipole.pipelines.sfm.config import MapperConfig, ReconstructConfig
from epipole.pipelines.sfm.mapping_stage import gps_note, reasons_in_words
from epipole.pipelines.sfm.page import render_report
from epipole.pipelines.sfm.page_content import page_content
from epipole.pipelines.sfm.pipeline import Solution, solve
from epipole.pipelines.sfm.results import write_results
from epipole.runs import ExecutorChoice, Job, ProgressCallback, ignore_progress, open_run
from epipole.scene import Reconstruction


@dataclass(frozen=True, slots=True, eq=False)
class ReconstructionResult:
    """What `reconstruct` returns; everything is also in the output folder."""

    out: Path
    models: tuple[Reconstruction, ...]
    """Largest first; more than one when the pictures do not connect."""
    reasons: dict[str, str]
    """Why each picture without a place has none."""
    warnings: tuple[str, ...]
    timings_s: dict[str, float]
    summary: dict[str, Any]
    """As in `summary.json`."""

    @property
    def model(self) -> Reconstruction:
        """The largest model."""
        return self.models[0]

    def __repr__(self) -> str:
        return f"ReconstructionResult({self.model!r} in {self.out})"


def reconstruct(
    images: str | Path,
    out: str | Path,
    config: ReconstructConfig | None = None,
    progress: ProgressCallback = ignore_progress,
    *,
    executor: ExecutorChoice | None = None,
    **options: Any,
) -> ReconstructionResult:
    """Make a 3D model from a folder of photographs or a video, with a report; a stopped run continues.

    Args:
        images: folder of photographs (JPEG, PNG, TIFF, WebP; sub-folders too) or a video file.
        out: output folder, made if missing.
        config: options; None for the defaults.
        progress: called with the progress of each stage.
        executor: what works on single pictures and pairs, instead of the config's choice: a name or any
            `concurrent.futures.Executor`, such as Dask's `Client.get_executor()`.
        **options: single options of the config by name, which override it: `single_camera=True`.

    Raises:
        NoModelError: the pictures give no model; the message says why.
        WorkspaceError: the output folder cannot be used.
        ConfigError: an option is unknown, or does not fit the pictures.
    """
    config, out, source = options_of(ReconstructConfig, config, options), as_path(out), as_path(images)
    if not source.exists():
        raise NoModelError(f"{source} does not exist")
    settings = asdict(config)
    job = Job(
        kind="reconstruct",
        inputs=(source,),
        settings={"seed": config.mapper.seed, "config": settings},
        threads=config.threads,
        executor=config.executor if executor is None else executor,
        progress=progress,
        opencv_alone=True,
    )
    with open_run(job, out) as run:
        solution = solve(source, run, config)
        reasons = _reasons(solution, config)
        with run.stage("write"):
            write_results(solution, run)
        run.warnings += [*solution.notes, *_warnings(solution, reasons, config.mapper)]
        with run.stage("report"):
            content = page_content(solution, reasons, run, settings)
            run.folder.write_text("report.html", render_report(content))
        summary = _summary(solution, reasons, run.warnings, run.seconds, run.timings_s)
        run.finish(summary)
    return ReconstructionResult(
        out, solution.mapped.models, reasons, tuple(run.warnings), run.timings_s, summary
    )


def _reasons(solution: Solution, config: ReconstructConfig) -> dict[str, str]:
    return reasons_in_words(
        solution.images,
        solution.mapped,
        solution.view_graph,
        solution.keypoints,
        config.mapper.resection_min_inliers,
    )


def _warnings(solution: Solution, reasons: dict[str, str], config: MapperConfig) -> list[str]:
    out, mapped, images = [], solution.mapped, solution.images
    for number, agreement in enumerate(mapped.agreements):
        if agreement < config.min_final_agreement:
            out.append(
                f"model {number} agrees with only {100 * agreement:.0f} % of its own matches: "
                "parts of it are probably wrong (a wrong focal length, or things that look alike)"
            )
    if reasons:
        out.append(f"{len(reasons)} of {len(images) + len(images.left_out)} pictures are in no model")
    if note := gps_note(images, mapped, config):
        out.append(note)
    if len(mapped.models) > 1:
        counts = ", ".join(str(int(m.is_registered().sum())) for m in mapped.models)
        out.append(
            f"the pictures fall into {len(mapped.models)} models that do not connect ({counts} pictures)"
        )
    return out


def _summary(
    solution: Solution,
    reasons: dict[str, str],
    warnings: list[str],
    seconds: float,
    timings_s: dict[str, float],
) -> dict[str, Any]:
    models, images = solution.mapped.models, solution.images
    model, residuals = models[0], solution.mapped.gps_residuals_m[0]
    return {
        "num_images": len(images) + len(images.left_out),
        "num_registered": int(model.is_registered().sum()),
        "models": [
            {
                "num_registered": int(m.is_registered().sum()),
                "num_points": len(m.points),
                "num_observations": len(m.tracks.image),
                "mean_reprojection_error_px": m.mean_reprojection_error_px(),
                "match_agreement": agreement,
            }
            for m, agreement in zip(models, solution.mapped.agreements)
        ],
        "num_points": len(model.points),
        "num_observations": len(model.tracks.image),
        "mean_reprojection_error_px": model.mean_reprojection_error_px(),
        "is_metric": residuals is not None,
        "median_gps_residual_m": None if residuals is None else float(np.nanmedian(residuals)),
        "cameras": [repr(model.cameras[c]) for c in range(len(model.cameras))],
        "focal_sources": list(images.focal_sources),
        "not_registered": reasons,
        "warnings": warnings,
        "seconds": seconds,
        "compile_seconds": compile_seconds(),
        "timings_s": timings_s,
    }
