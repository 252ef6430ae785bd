"""The merging job: finished models of overlapping images become one, which starts from their poses.

Images are linked into one folder; features and matches of the earlier runs are kept. Similar images of different models are matched,
the models are joined by the points that they then have in common (`mappers/joining.py`), and everything is adjusted together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Unpack

import numpy as np

from epipole._checks import as_path
from epipole.config import options_of
from epipole.errors import ConfigError, FileFormatError
from epipole.io.colmap.model import find_model, read_colmap_model
from epipole.io.files import missing_in_words
from epipole.io.images.photographs import link_or_copy, list_photographs
from epipole.io.workspaces import DATABASE, IMAGES, workspace_of_model
from epipole.pipelines.sfm.anchored import scale_of_workspace
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.pipelines.sfm.inputs import CONTENTS, UNITS
from epipole.pipelines.sfm.mappers.growth import Earlier
from epipole.pipelines.sfm.matching.pairing import EarlierDatabase
from epipole.pipelines.sfm.options import ReconstructKeywords
from epipole.pipelines.sfm.pipeline import Solution, solve
from epipole.pipelines.sfm.run import ReconstructionResult, check_inputs, executor_of, finish_reconstruction
from epipole.runs import Job, ProgressCallback, Run, content_digests, ignore_progress, open_run
from epipole.scene import Reconstruction

KEPT_UNITS = ("features", "matches", "geometry", "geometry-calibrated")
"""Folders of results in a workspace that the merged one can use: their files are named by what they were made from."""
PHOTOGRAPHS = f"{UNITS}/merged"
"""Folder of links to the images of all models, in the output folder."""


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """A finished model."""

    root: Path
    model: Reconstruction
    images: tuple[str, ...]
    """Names of its images, also of those that it has not registered."""


def merge(
    models: Sequence[str | Path],
    out: str | Path,
    config: ReconstructConfig | None = None,
    progress: ProgressCallback = ignore_progress,
    **options: Unpack[ReconstructKeywords],
) -> ReconstructionResult:
    """Merge finished models of overlapping images; the result has the coordinates of the first one. The models do not change.

    Args:
        models: output folders of `reconstruct`, or COLMAP models, each with `images/` and `database.db`; two or more.
        out: output folder, which then also has the images and a database.
        config: options, as of `reconstruct`; None for the defaults.
        progress: called with the progress of each stage.
        **options: single options by name, which override `config`.

    Returns:
        As of `reconstruct`. If the models have too few points in common, the others are mapped anew as separate models, with a warning.

    Raises:
        FileFormatError: a model, its images or its database are missing.
        ConfigError: fewer than two models are given, or an option does not apply.
        NoModelError: no model can be reconstructed.
        WorkspaceError: the output folder cannot be used.
    """
    config = options_of(ReconstructConfig, config, options, ["config", "progress"]).seeded()
    folders, target = [as_path(one) for one in models], as_path(out)
    _check(folders, target, config)
    check_inputs(folders[0], config)
    job = Job(
        kind="merge",
        inputs=tuple(folders),
        settings={"seed": config.seed, "config": asdict(config)},
        threads=config.threads,
        executor=executor_of(None, config),
        progress=progress,
        opencv_alone=True,
        has_log=True,
    )
    with open_run(job, target) as run:
        with run.stage("open"):
            parts = [_part_of(folder) for folder in folders]
            if len({part.root.resolve() for part in parts}) < len(parts):
                raise ConfigError("the same model is given twice")
            names = _link_images(parts, run)
            _link_units(parts, run)
        earlier = Earlier(
            tuple(_renamed(part.model, own) for part, own in zip(parts, names)),
            tuple(EarlierDatabase(part.root / DATABASE, own) for part, own in zip(parts, names)),
        )
        solution = solve(run.root / PHOTOGRAPHS, run, config, earlier)
        run.warnings += _notes(solution, parts, names)
        run.warnings += _notes_on_scale(solution, parts, is_measured=_measures_scale(config))
        if config.rigs is None:
            run.warnings += _notes_on_rigs(parts)
        return finish_reconstruction(solution, run, config, parts[0].root)


def _check(folders: Sequence[Path], target: Path, config: ReconstructConfig) -> None:
    if len(folders) < 2:
        raise ConfigError(f"merging needs two models or more, got {len(folders)}")
    for name in ("database", "pairs", "grow", "known_poses", "masks", "include", "exclude"):
        if getattr(config, name):
            raise ConfigError(
                f"{name} cannot be used to merge models: images and matches are those of the models"
            )
    for folder in folders:
        if not folder.exists():
            raise FileFormatError(folder, missing_in_words(folder))
        if folder.resolve() == target.resolve():
            raise ConfigError(f"{target} is one of the models: choose another output folder")


def _part_of(folder: Path) -> _Part:
    """Read a model.

    Raises:
        FileFormatError: its images or its database are missing.
    """
    root = workspace_of_model(folder, IMAGES, DATABASE)
    if root is None:
        raise FileFormatError(folder, f"merging needs the folder {IMAGES} and {DATABASE} beside the model")
    model = read_colmap_model(find_model(folder))
    names = list_photographs(root / IMAGES).names
    missing = sorted(
        {model.images.name[k] for k in np.flatnonzero(model.is_registered()).tolist()} - {*names}
    )
    if missing:
        raise FileFormatError(root / IMAGES, f"it has no {missing[0]}, which the model has registered")
    return _Part(root, model, names)


def _link_images(parts: Sequence[_Part], run: Run) -> list[dict[str, str]]:
    """Link the images of all models into one folder; returns, for each model, the present name by the earlier one.

    The same file in two models is linked once. Different files of one name get the name of their workspace as a folder.
    """
    paths = [part.root / IMAGES / name for part in parts for name in part.images]
    digests = content_digests(paths, run.root / CONTENTS, run.job.progress)
    by_content: dict[str, str] = {}
    taken: set[str] = set()
    out: list[dict[str, str]] = []
    for number, part in enumerate(parts):
        own: dict[str, str] = {}
        for name in part.images:
            key = digests[part.root / IMAGES / name]
            if (
                key not in by_content or by_content[key] in own.values()
            ):  # a copy within one model is another image
                by_content[key] = _free_name(name, part, number, taken)
                taken.add(by_content[key])
            own[name] = by_content[key]
        out.append(own)
    with run.folder.replacing(PHOTOGRAPHS, [f"{PHOTOGRAPHS}/{name}" for name in sorted(taken)]):
        for part, own in zip(parts, out):
            for before, name in own.items():
                link_or_copy((part.root / IMAGES / before).resolve(), run.root / PHOTOGRAPHS / name)
    return out


def _free_name(name: str, part: _Part, number: int, taken: set[str]) -> str:
    for candidate in (name, f"{part.root.resolve().name}/{name}"):
        if candidate not in taken:
            return candidate
    return f"model_{number + 1}/{name}"


def _link_units(parts: Sequence[_Part], run: Run) -> None:
    """Link features and matches of the earlier runs, which are used where nothing has changed."""
    for part in parts:
        for folder in KEPT_UNITS:
            for path in sorted((part.root / UNITS / folder).glob("*.npz")):
                target = run.root / UNITS / folder / path.name
                if not target.exists():
                    link_or_copy(path.resolve(), target)


def _renamed(model: Reconstruction, names: dict[str, str]) -> Reconstruction:
    """The model with its images under their present names."""
    renamed = tuple(names.get(name, name) for name in model.images.name)
    return replace(model, images=replace(model.images, name=renamed))


def _notes(solution: Solution, parts: Sequence[_Part], names: Sequence[dict[str, str]]) -> list[str]:
    """Warnings about models that stay separate, and about images that the merged model lost."""
    if not solution.mapped.models:
        return []
    methods, out = solution.mapped.methods, []
    merged = solution.mapped.models[methods.index("grown") if "grown" in methods else 0]
    registered = {merged.images.name[k] for k in np.flatnonzero(merged.is_registered()).tolist()}
    if "grown" not in methods:
        out.append(
            "the given models do not fit the matches, so all images were mapped anew: the coordinates are different"
        )
    elif merged.georeference is not None and parts[0].model.georeference is None:
        out.append(
            f"GPS determines the coordinates of the merged model, which are not those of {parts[0].root}"
        )
    for part, own in zip(parts, names):
        at = part.model.is_registered()
        here = {own[name] for k, name in enumerate(part.model.images.name) if at[k]}
        if not here & registered:
            out.append(
                f"{part.root} has too few points in common with the other models, since their images do not overlap enough: it was mapped "
                "anew as a separate model"
            )
        elif lost := sorted(here - registered):
            out.append(
                f"{len(lost)} images of {part.root} are not in the merged model, such as {lost[0]}: the report gives the reasons"
            )
    return out


def _notes_on_rigs(parts: Sequence[_Part]) -> list[str]:
    """A warning if rigs of the models are lost."""
    if not any((np.diff(part.model.rigs.sensor_offsets) > 1).any() for part in parts):
        return []
    return [
        "the given models have rigs, but the merged model does not: pass --rigs with a file for the present image names"
    ]


def _measures_scale(config: ReconstructConfig) -> bool:
    """Whether the options give the merged model its own scale."""
    return config.rigs is not None or not config.anchors.is_empty


def _notes_on_scale(solution: Solution, parts: Sequence[_Part], *, is_measured: bool) -> list[str]:
    """A warning if the first model, whose coordinates stay, is without the scale or the position on Earth that another one has.

    is_measured: whether the merged model gets a scale otherwise.
    """
    methods = solution.mapped.methods
    if "grown" not in methods or solution.mapped.models[methods.index("grown")].georeference is not None:
        return []
    is_metric = [
        part.model.georeference is not None or scale_of_workspace(part.root) is not None for part in parts
    ]
    if (better := next((k for k, part in enumerate(parts) if part.model.georeference is not None), 0)) > 0:
        lost = "has a position on Earth, which the merged model has not"
    elif not is_measured and not is_metric[0] and any(is_metric):
        better, lost = is_metric.index(True), "is in meters, and the merged model is not"
    else:
        return []
    return [
        f"{parts[better].root} {lost}: its coordinates are those of {parts[0].root}; to keep them, give {parts[better].root} first"
    ]
