"""The localization job: poses of new images in a finished model, which does not change."""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from epipole import _parallel
from epipole._checks import as_path
from epipole.cameras import Camera
from epipole.config import options_of
from epipole.errors import ConfigError, FileFormatError, NoModelError, WorkspaceError
from epipole.io.colmap.model import write_colmap_model
from epipole.io.files import missing_in_words, read_json
from epipole.io.images.formats import FORMAT_OF_SUFFIX
from epipole.io.images.photographs import link_or_copy, read_header
from epipole.io.json_files import json_text
from epipole.io.meshes.ply import write_scene_ply
from epipole.pipelines.localization.config import LocalizeConfig
from epipole.pipelines.localization.extended_model import names_in_model, with_localized
from epipole.pipelines.localization.localized_image import LocalizedImage
from epipole.pipelines.localization.localizer import FocalKnowledge, Localizer
from epipole.pipelines.localization.options import LocalizeKeywords
from epipole.pipelines.localization.page import render_page
from epipole.pipelines.localization.query_cameras import QueryCamera, query_cameras
from epipole.pipelines.localization.reference import workspace_of
from epipole.pipelines.localization.results import image_summary, poses_text
from epipole.pipelines.localization.shared_focal import localize_images_of_camera
from epipole.pipelines.sfm.inputs import CONTENTS, UNITS, image_set_of
from epipole.pipelines.sfm.matching.feature_stage import feature_units, load_features
from epipole.pipelines.sfm.matching.unit_tables import FEATURES
from epipole.pipelines.sfm.photographs import ImageSet, read_image_set
from epipole.report.markup import plural
from epipole.report.space_scene import METERS, NO_UNIT
from epipole.runs import Job, ProgressCallback, Run, Unit, ignore_progress, load, open_run
from epipole.scene import Reconstruction

IMAGES = "images"
"""Folder of the model's images in its workspace."""
AT_ONCE = 16
"""Images between two reports of progress."""
FOLDER = "localized"
"""Output folder in that of the model, unless another is given."""


@dataclass(frozen=True, slots=True, eq=False)
class LocalizationResult:
    """Result of `localize`, which is also in the output folder."""

    out: Path
    model: Reconstruction
    """The model with the localized images."""
    images: dict[str, LocalizedImage]
    """Of each image, by name."""
    reasons: dict[str, str]
    """Reason for each image that is not localized."""
    warnings: tuple[str, ...]
    summary: dict[str, Any]
    """As in `summary.json`."""

    @property
    def num_localized(self) -> int:
        """Number of localized images."""
        return sum(image.success for image in self.images.values())

    def __repr__(self) -> str:
        count = len(self.images) + sum(name not in self.images for name in self.reasons)
        return f"LocalizationResult({self.num_localized} of {count} images in {self.out})"


def localize(
    images: str | Path,
    workspace: str | Path,
    out: str | Path | None = None,
    config: LocalizeConfig | None = None,
    progress: ProgressCallback = ignore_progress,
    **options: Unpack[LocalizeKeywords],
) -> LocalizationResult:
    """Localize images in a finished model: poses with covariances; the model does not change.

    Args:
        images: folder of photographs, one photograph, or a video.
        workspace: output folder of `reconstruct`, or a COLMAP model beside its database.db.
        out: output folder; None: `WORKSPACE/localized`.
        config: options; None for the defaults.
        progress: called with the progress of each stage.
        **options: single options by name, which override `config`: `camera_params="525,525,320,240"`.

    Raises:
        FileFormatError: there is no model or no database, they do not belong to each other, or the photograph is damaged.
        NoModelError: there are no usable images. An image that cannot be localized is no error.
        WorkspaceError: the output folder cannot be used.
        ConfigError: an option is unknown, or does not match the images.
    """
    config = options_of(LocalizeConfig, config, options, ["out", "config", "progress"])
    source, workspace = as_path(images), as_path(workspace)
    _check_source(source, config)
    if not workspace.exists():
        raise FileFormatError(workspace, missing_in_words(workspace))
    root = workspace_of(workspace)
    out = _output_folder(out, root)
    job = Job(
        kind="localize",
        inputs=(source, workspace),
        settings={"config": asdict(config)},
        threads=config.threads,
        progress=progress,
        opencv_alone=True,
    )
    with open_run(job, out) as run:
        with run.stage("open"):
            run.report("open", 0, 1)
            localizer = Localizer.open(workspace, config.localizer)
            run.report("open", 1, 1)
        with run.stage("read"):
            found = _images_of(source, run, config)
            model, is_given = localizer.reference.model, config.for_images().has_known_camera
            cameras = query_cameras(found, model, root / IMAGES, is_given=is_given)
        with run.stage("features"):
            units = feature_units(
                found, run.root / UNITS / "features", config.localizer.features, config.masks
            )
            run.do(units, "features")
        with run.stage("localize"):
            localized, failures = _localize_all(localizer, found, cameras, units, run)
        return _write(localizer, found, cameras, localized, failures, run)


def _output_folder(out: str | Path | None, root: Path) -> Path:
    """The given folder, or the usual one in the workspace.

    Raises:
        WorkspaceError: it is the workspace.
    """
    folder = root / FOLDER if out is None else as_path(out)
    if folder.resolve() == root.resolve():
        raise WorkspaceError(f"{folder} is the folder of the model: choose another output folder")
    return folder


def _check_source(source: Path, config: LocalizeConfig) -> None:
    """Check that the images exist.

    Raises:
        NoModelError: the path does not exist.
        FileFormatError: it is a photograph that cannot be read.
        ConfigError: it is a photograph, but patterns are given, too.
    """
    if not source.exists():
        raise NoModelError(f"{source} does not exist")
    if not _is_photograph(source):
        return
    if config.include or config.exclude:
        raise ConfigError(f"include and exclude select images of a folder, but {source} is one image")
    read_header(source)


def _is_photograph(source: Path) -> bool:
    return source.is_file() and source.suffix.lower() in FORMAT_OF_SUFFIX


def _images_of(source: Path, run: Run, config: LocalizeConfig) -> ImageSet:
    """The images of a folder, a video, or a single photograph, which is copied to a separate folder."""
    if not _is_photograph(source):
        return image_set_of(source, run, config.for_images())
    folder = run.root / UNITS / "photograph"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    link_or_copy(source.resolve(), folder / source.name)
    return read_image_set(folder, config.for_images(), run.root / CONTENTS, progress=run.job.progress)


def _localize_all(
    localizer: Localizer,
    images: ImageSet,
    cameras: Sequence[QueryCamera],
    units: Sequence[Unit],
    run: Run,
) -> tuple[dict[int, LocalizedImage], dict[int, str]]:
    """The result of each readable image, and why the others are not readable."""
    failures = {
        row: why
        for row, unit in enumerate(units)
        if (why := str(load(unit.path, FEATURES, "failure")["failure"]))
    }
    rows = [row for row in range(len(images)) if row not in failures]
    done = 0

    def localize_all(chosen: Sequence[int], camera: Camera, focal: FocalKnowledge) -> list[LocalizedImage]:
        nonlocal done
        found: list[LocalizedImage] = []
        for start in range(0, len(chosen), AT_ONCE):
            some = chosen[start : start + AT_ONCE]

            def one(k: int, some: Sequence[int] = some) -> LocalizedImage:
                features = load_features(units[some[k]].path)
                return localizer.localize_features(features, camera, focal)

            found += _parallel.map_items(one, len(some))
            done = min(done + len(some), len(rows))  # images may be localized a second time
            run.report("localize", done, len(rows))
        return found

    run.report("localize", 0, len(rows))
    out: dict[int, LocalizedImage] = {}
    for c, query in enumerate(cameras):
        chosen = [row for row in rows if images.camera_of_image[row] == c]
        out |= dict(zip(chosen, localize_images_of_camera(query, chosen, localize_all)))
    return out, failures


def _write(
    localizer: Localizer,
    images: ImageSet,
    cameras: Sequence[QueryCamera],
    localized: dict[int, LocalizedImage],
    failures: dict[int, str],
    run: Run,
) -> LocalizationResult:
    rows = sorted(localized)
    names = [images.names[row] for row in rows]
    found = [localized[row] for row in rows]
    before = localizer.reference.model
    good = [k for k, image in enumerate(found) if image.success]
    localized_names = names_in_model(before, [names[k] for k in good])
    timestamps_s = images.timestamps_s[[rows[k] for k in good]]
    model = with_localized(before, localized_names, [found[k] for k in good], timestamps_s)
    reasons = {
        **images.left_out,
        **{images.names[row]: why for row, why in failures.items()},
        **{name: image.reason.value for name, image in zip(names, found) if not image.success},
    }
    run.warnings += [
        *images.notes,
        *_warnings(names, found, [cameras[int(images.camera_of_image[r])] for r in rows]),
    ]
    entries = {
        name: image_summary(image, before, camera=cameras[int(images.camera_of_image[row])])
        for row, name, image in zip(rows, names, found)
    }
    with run.stage("write"), run.folder.publish("model") as aside:
        write_colmap_model(model, aside / "sparse" / "0")
        write_scene_ply(aside / "points.ply", before)
        (aside / "localized.json").write_text(json_text(entries, indent=1), encoding="utf-8")
        (aside / "poses.txt").write_text(poses_text(names, found), encoding="utf-8")
    unit = METERS if before.georeference is not None else _unit_of(workspace_of(run.job.inputs[1]))
    errors = [found[k].error_px for k in good]
    summary = {
        "num_images": len(images) + len(images.left_out),
        "num_localized": len(good),
        "is_metric": unit == METERS,
        "median_error_px": float(np.median(errors)) if errors else None,
        "names_in_model": list(localized_names),
        "not_localized": reasons,
        "warnings": run.warnings,
        "seconds": run.seconds,
        "timings_s": run.timings_s,
        "peak_memory_mb": run.peak_memory_mb,
    }
    run.folder.write_text(
        "report.html", render_page(run.warnings, model, localized_names, entries, reasons, unit)
    )
    run.finish(summary)
    return LocalizationResult(run.root, model, dict(zip(names, found)), reasons, tuple(run.warnings), summary)


def _unit_of(workspace: Path) -> str:
    """Unit of the model, from the summary of the run that made it; of a COLMAP model, it is unknown."""
    try:
        summary = read_json(workspace / "summary.json")
    except FileFormatError:
        return NO_UNIT
    return METERS if isinstance(summary, dict) and summary.get("is_metric") is True else NO_UNIT


def _warnings(
    names: Sequence[str], found: Sequence[LocalizedImage], cameras: Sequence[QueryCamera]
) -> list[str]:
    """Notes on images of something else, and on focal lengths that the points contradict."""
    out = []
    if found and not any(image.success for image in found):
        out.append(
            f"no image of {len(found)} is localized: they may not show what the model shows; the summary has the reasons"
        )
    wrong = [
        k
        for k, image in enumerate(found)
        if image.success and image.is_focal_contradicted and cameras[k].is_given
    ]
    if wrong:
        percent = 100.0 * float(np.median([found[k].focal_correction for k in wrong]))
        out.append(
            f"the points of {plural(len(wrong), 'image')} (such as {names[wrong[0]]}) contradict the given focal length: one that is "
            f"{abs(percent):.1f} % {'longer' if percent > 0 else 'shorter'} fits better; check --camera-params or --calibration"
        )
    changed = [
        k
        for k, image in enumerate(found)
        if image.success
        and cameras[k].is_known
        and not cameras[k].is_given
        and _is_other_focal(image, cameras[k])
    ]
    if changed:
        k = changed[0]
        out.append(
            f"{plural(len(changed), 'image')} (such as {names[k]}) of the size of the model's images: another focal length "
            f"({found[k].camera.focal_px:.0f} instead of {cameras[k].camera.focal_px:.0f} px), which was estimated"
        )
    return out


def _is_other_focal(image: LocalizedImage, query: QueryCamera) -> bool:
    return not math.isclose(image.camera.focal_px, query.camera.focal_px, rel_tol=1e-9)
