"""The `reconstruct` job: from photographs or a video to models, points, a database and a report."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from epipole._checks import as_path
from epipole._jit import compile_seconds
from epipole.config import options_of
from epipole.errors import ConfigError, FileFormatError, NoModelError
from epipole.io.colmap.rig_config import read_rig_config
from epipole.pipelines.sfm.anchored import gps_estimate, scale_of_workspace, with_scale
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.pipelines.sfm.mappers.growth import Earlier, earlier_model_in
from epipole.pipelines.sfm.mapping_stage import reasons_in_words
from epipole.pipelines.sfm.notes import (
    absences_of,
    focal_source,
    notes_on_choice_and_cameras,
    scale_in_words,
    undetermined_focals,
    warnings_of,
)
from epipole.pipelines.sfm.options import ReconstructKeywords
from epipole.pipelines.sfm.page.content import page_content
from epipole.pipelines.sfm.page.page import render_report
from epipole.pipelines.sfm.pipeline import Solution, solve
from epipole.pipelines.sfm.results import write_results
from epipole.pipelines.sfm.rigs.assignment import assign_images
from epipole.pipelines.sfm.rigs.rig_model import with_rigs
from epipole.runs import (
    ExecutorChoice,
    Job,
    PassedExecutor,
    ProgressCallback,
    Run,
    chosen_executor,
    ignore_progress,
    open_run,
)
from epipole.runs.earlier import continue_with, note_on_poorer
from epipole.scale import ScaleEstimate, check_anchor_files
from epipole.scene import Reconstruction
from epipole.scene.notebook import table_html

GROW_INSTEAD = {
    "georeference": "grow the model that it was made from, and georeference it again",
    "merge": "reconstruct the further images together with some that overlap them, and merge the two models",
}
"""What to do with models of other commands."""


@dataclass(frozen=True, slots=True, eq=False)
class ReconstructionResult:
    """Result of `reconstruct`, which is also in the output folder."""

    out: Path
    models: tuple[Reconstruction, ...]
    """Largest first; more than one if the images do not connect."""
    reasons: dict[str, str]
    """Reason for each image that is not registered."""
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

    def _repr_html_(self) -> str:
        rows = {"models": len(self.models), "model": self.model, "warnings": len(self.warnings)}
        return table_html("ReconstructionResult", rows | {"folder": self.out})


def reconstruct(
    images: str | Path,
    out: str | Path,
    config: ReconstructConfig | None = None,
    progress: ProgressCallback = ignore_progress,
    *,
    executor: PassedExecutor | None = None,
    **options: Unpack[ReconstructKeywords],
) -> ReconstructionResult:
    """Reconstruct a 3D model from a folder of photographs or a video, with a report; an interrupted run continues.

    Args:
        images: folder of photographs (JPEG, PNG, TIFF, WebP; including subfolders) or a video file.
        out: output folder, created if missing.
        config: options; None for the defaults.
        progress: called with the progress of each stage.
        executor: executor for images and pairs, instead of the config's choice: a name or any
            `concurrent.futures.Executor`, or a `distributed.Client` (Dask) whose workers see the same folders.
        **options: single options by name, which override `config`: `single_camera=True`.

    Raises:
        NoModelError: no model can be reconstructed; the message gives the reason.
        WorkspaceError: the output folder cannot be used.
        ConfigError: an option is unknown, or does not match the images.
        FileFormatError: a file given as an option is missing or cannot be read.
    """
    config = options_of(ReconstructConfig, config, options, ["config", "progress", "executor"]).seeded()
    out, source = as_path(out), as_path(images)
    check_inputs(source, config)
    job = Job(
        kind="reconstruct",
        inputs=(source,),
        settings={"seed": config.seed, "config": asdict(config)},
        threads=config.threads,
        executor=executor_of(executor, config),
        progress=progress,
        opencv_alone=True,
        has_log=True,
    )
    if config.grow:
        earlier_model_in(out)  # before anything there changes
        continue_with(out, job.kind, job.inputs, GROW_INSTEAD)
    with open_run(job, out) as run:
        earlier = Earlier.of_output(run.root) if config.grow else None
        solution = solve(source, run, config, earlier)
        return finish_reconstruction(solution, run, config, run.root if config.grow else None)


def finish_reconstruction(
    solution: Solution, run: Run, config: ReconstructConfig, earlier: Path | None = None
) -> ReconstructionResult:
    """Determine the scale, and write the models and the report.

    Args:
        solution: the models.
        run: output folder and progress.
        config: options.
        earlier: workspace of the model from which the first one grew, whose scale it keeps.

    Raises:
        NoModelError: there is no model; the message gives the reason.
    """
    rigs: dict[str, Any] = {}
    if solution.mapped.models:
        is_grown = solution.mapped.methods[0] == "grown"
        before = (
            scale_of_workspace(earlier) if earlier is not None and is_grown else _scale_of_poses(solution)
        )
        if config.rigs is not None:
            with run.stage("rigs"):
                solution, scale, rigs = _with_rigs(solution, run, config, before)
            before = scale or before
        with run.stage("anchor"):
            mapped, notes = with_scale(solution, config, run.job.progress, before)
        run.warnings += notes
        with run.stage("check"):
            solution = replace(solution, mapped=mapped).with_focals()
    reasons = _reasons(solution, config)
    with run.stage("write"):
        write_results(solution, run)
    run.warnings += _notes_on_earlier(solution, run.root, config)
    run.warnings += [*notes_on_choice_and_cameras(solution), *warnings_of(solution, config.mapper)]
    with run.stage("report"):
        content = page_content(solution, reasons, run, asdict(config), rigs)
        run.folder.write_text("report.html", render_report(content))
    run.warnings += absences_of(solution, reasons)  # the report has its own text for these
    summary = _summary(solution, reasons, run) | ({"rigs": rigs} if rigs else {})
    run.finish(summary)
    return ReconstructionResult(
        run.root, solution.mapped.models, reasons, tuple(run.warnings), run.timings_s, summary
    )


def _scale_of_poses(solution: Solution) -> ScaleEstimate | None:
    """The scale that the known poses give the largest model, if they fit it."""
    known, fit = solution.images.known_poses, solution.mapped.pose_fits[0]
    if known is None or fit is None or not known.is_metric:
        return None
    return fit.scale(solution.mapped.models[0].cams_from_world(), known)


def _with_rigs(
    solution: Solution, run: Run, config: ReconstructConfig, before: ScaleEstimate | None
) -> tuple[Solution, ScaleEstimate | None, dict[str, Any]]:
    """The solution with the rigs of the option; also the scale that they give the largest model, and their geometry there.

    before: scale of the largest model, if it is known other than by GPS.
    """
    assert config.rigs is not None
    run.report("rigs", 0, 1)
    assignment = assign_images(solution.images.names, read_rig_config(config.rigs))
    metric = gps_estimate(solution.mapped, solution.images, config) or before
    found = [
        with_rigs(model, assignment, config.mapper, None if number else metric)
        for number, model in enumerate(solution.mapped.models)
    ]
    run.report("rigs", 1, 1)
    run.warnings += found[0].notes
    mapped = replace(solution.mapped, models=tuple(one.model for one in found))
    return replace(solution, mapped=mapped), found[0].scale, found[0].geometry


def executor_of(given: PassedExecutor | None, config: ReconstructConfig) -> ExecutorChoice:
    """The executor that is passed, else the cluster of the options, else their executor."""
    return chosen_executor(
        given, config.cluster, has_shared_folder=config.shared_folder, default=config.executor
    )


def check_inputs(source: Path, config: ReconstructConfig) -> None:
    """Check, before any work, that all given files exist.

    Raises:
        NoModelError: the source is missing.
        ConfigError: the folder of masks is missing.
        FileFormatError: another file is missing.
    """
    if not source.exists():
        hint = "; give the folder, and the pattern with --include" if set("*?[") & set(source.name) else ""
        raise NoModelError(f"{source} does not exist{hint}")
    if not (source.is_dir() or source.is_file()):
        raise NoModelError(f"{source} is neither a folder of photographs nor a video, but a pipe or a device")
    if config.masks is not None and not config.masks.is_dir():
        what = "is a file" if config.masks.exists() else "does not exist"
        raise ConfigError(f"masks must be a folder of masks: {config.masks} {what}")
    named = {name: getattr(config, name) for name in ("calibration", "pairs", "database", "known_poses")}
    for name, path in named.items():
        if path is not None and not path.exists():
            raise FileFormatError(path, f"it does not exist ({name})")
    check_anchor_files(config.anchors)


def _notes_on_earlier(solution: Solution, out: Path, config: ReconstructConfig) -> list[str]:
    """Warnings if an earlier result has more registered images, or if the model does not grow from it."""
    num_registered = int(solution.mapped.models[0].is_registered().sum())
    notes = note_on_poorer(out, "num_registered", num_registered, "registered images")
    if config.grow and solution.mapped.methods[0] != "grown":
        notes.append(
            "the earlier model does not fit the images, so they were mapped anew: the coordinates are different (grow)"
        )
    return notes


def _reasons(solution: Solution, config: ReconstructConfig) -> dict[str, str]:
    return reasons_in_words(
        solution.images,
        solution.mapped,
        solution.view_graph,
        solution.contradicting.view_graph,
        solution.keypoints,
        config.mapper,
    )


def _contradicting(solution: Solution) -> list[dict[str, Any]]:
    """The pairs that are not used: names, matches, and what they contradict."""
    found, names = solution.contradicting, solution.images.names
    graph, off_deg = found.view_graph, np.degrees(found.angle_rad)
    return [
        {
            "images": [names[graph.image1[k]], names[graph.image2[k]]],
            "num_matches": int(graph.num_inliers()[k]),
            "rotation_off_deg": _finite(round(float(off_deg[k]), 2)),
            "holds_conflicting_points": bool(found.is_conflicting[k]),
            "conflicting_fraction": _finite(round(float(found.conflict_fraction[k]), 3)),
        }
        for k in range(len(found))
    ]


def _rescue(solution: Solution) -> dict[str, Any]:
    """What learned features were used for, and how many of these images a model has."""
    names, models, weak = solution.images.names, solution.mapped.models, solution.rescue.images
    is_registered = np.any([model.is_registered() for model in models], axis=0)
    return {
        "images": [names[i] for i in weak],
        "num_pairs": solution.rescue.num_pairs,
        "num_registered": int(is_registered[list(weak)].sum()),
    }


def _summary(
    solution: Solution,
    reasons: dict[str, str],
    run: Run,
) -> dict[str, Any]:
    models, images = solution.mapped.models, solution.images
    model, gps, scale = models[0], solution.mapped.gps[0], solution.mapped.scale
    return {
        "num_images": len(images) + len(images.left_out),
        "num_registered": int(model.is_registered().sum()),
        "num_masked": images.num_masked,
        "models": [
            {
                "num_registered": int(m.is_registered().sum()),
                "num_points": len(m.points),
                "num_observations": len(m.tracks.image),
                "mean_reprojection_error_px": _finite(m.mean_reprojection_error_px()),
                "match_agreement": agreement,
                "mapper": method,
                "num_overlapping_pairs": int(found.is_judged.sum()),
                "num_conflicting_pairs": int(found.is_contradiction.sum()),
            }
            for m, agreement, method, found in zip(
                models, solution.mapped.agreements, solution.mapped.methods, solution.conflicts
            )
        ],
        "num_points": len(model.points),
        "num_observations": len(model.tracks.image),
        "mean_reprojection_error_px": _finite(model.mean_reprojection_error_px()),
        "is_metric": scale is not None,
        "scale": scale_in_words(solution),
        "anchor": None if scale is None else scale.summary(),
        "poses": None if (fit := solution.mapped.pose_fits[0]) is None else fit.summary(images.names),
        "median_gps_residual_m": None if gps is None else gps.median_m,
        "cameras": [repr(model.cameras[c]) for c in range(len(model.cameras))],
        "focal_sources": [focal_source(solution, c) for c in range(len(images.focal_sources))],
        "focals": [
            {
                "camera": c,
                "focal_px": focal.model_px,
                "estimated_px": focal.focal_px,
                "sigma_px": _finite(focal.sigma_px),
                "is_determined": focal.is_determined,
            }
            for c, focal in solution.focals.items()
        ],
        "is_shape_determined": not undetermined_focals(solution),
        "contradicting_pairs": _contradicting(solution),
        "rescue": _rescue(solution),
        "not_registered": reasons,
        "warnings": run.warnings,
        "seconds": run.seconds,
        "compile_seconds": compile_seconds(),
        "timings_s": run.timings_s,
        "peak_memory_mb": run.peak_memory_mb,
    }


def _finite(value: float) -> float | None:
    """None for NaN, which JSON does not have."""
    return value if math.isfinite(value) else None
