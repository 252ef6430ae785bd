"""The stereo jobs: one pair, many pairs, two images of a model, and the diagnosis of a pair."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from epipole._checks import as_path, checked
from epipole.config import options_of
from epipole.disparity_search.rectification import is_right_of_left
from epipole.errors import ConfigError, DegenerateGeometryError, FileFormatError
from epipole.io.colmap.model import find_model, read_colmap_model
from epipole.io.images.photographs import list_photographs
from epipole.io.models.images import ModelImages
from epipole.io.names import path_inside
from epipole.pipelines.stereo.config import StereoConfig
from epipole.pipelines.stereo.doctor import Diagnosis, examine
from epipole.pipelines.stereo.measured_pair import measured, summary_of_pair, write_pair
from epipole.pipelines.stereo.options import StereoKeywords
from epipole.pipelines.stereo.pair import StereoResult
from epipole.pipelines.stereo.pair_files import PairFiles, files_of_pair
from epipole.pipelines.stereo.pair_units import UNITS, PairPayload, results_of_unit, unit_of_pair
from epipole.pipelines.stereo.pairs import (
    StereoBatch,
    is_many,
    is_measured,
    list_pairs,
    read_summary,
    run_batch,
    summary_of,
)
from epipole.runs import (
    Job,
    ProgressCallback,
    Run,
    Unit,
    chosen_executor,
    has_own_model,
    ignore_progress,
    open_run,
)
from epipole.runs.folder import refuse_folder_of
from epipole.scene import RectifiedRig, StereoRig

WHERE = ("cluster", "shared_folder")
"""Options of where pairs are measured, which do not affect them."""


@checked
def stereo(
    left: str | Path,
    right: str | Path,
    out: str | Path,
    config: StereoConfig | None = None,
    rig: RectifiedRig | StereoRig | None = None,
    **options: Unpack[StereoKeywords],
) -> StereoResult:
    """Compute disparities with standard deviations, with a rig also depth and points, and write a report.

    Args:
        left: left image, whose pixels get a disparity.
        right: right image.
        out: output folder, created if missing.
        config: options; None for the defaults.
        rig: two calibrated cameras, by which the pair is rectified first; or the parameters of a rectified pair;
            None: the pair is assumed to be rectified, and there is no depth.
        **options: single options of the config by name, which override it: `max_disparity_px=96`.

    Raises:
        FileFormatError: an image cannot be read.
        ShapeError: the sizes of the images do not match each other or the calibration.
        ConfigError: an option is unknown, or left and right are swapped in the calibration.
        DegenerateGeometryError: the pair cannot be rectified.
        WorkspaceError: the output folder cannot be used.
    """
    config = options_of(StereoConfig, config, options, ["config", "rig"])
    _refuse_cluster(config)
    left, right = as_path(left), as_path(right)
    settings = _settings(config, rig, left, right)
    return _measured(files_of_pair(left, right, rig), as_path(out), config, settings)


def _refuse_cluster(config: StereoConfig) -> None:
    """Raise an error if a cluster is given for a single pair."""
    if config.cluster is not None:
        raise ConfigError("a cluster measures the pairs of two folders or videos, but this is a single pair")


def _measured(files: PairFiles, out: Path, config: StereoConfig, settings: dict[str, Any]) -> StereoResult:
    job = Job(kind="stereo", inputs=(files.left, files.right), settings=settings)
    with open_run(job, out) as run:
        result = measured(files, config)
        with run.folder.publish("stereo") as aside:
            write_pair(result, aside)
        run.finish(summary_of_pair(result))
        return replace(result, out=run.root)


@checked
def stereo_many(
    left: str | Path,
    right: str | Path,
    out: str | Path,
    config: StereoConfig | None = None,
    rig: RectifiedRig | StereoRig | None = None,
    progress: ProgressCallback = ignore_progress,
    **options: Unpack[StereoKeywords],
) -> StereoBatch:
    """`stereo` for every pair of two folders or of stereo video.

    Pass a video with both images side by side twice. A pair that fails is reported with its reason and does not stop the others;
    a stopped run can be continued.

    Args:
        left: folder of left images, or a video.
        right: folder of right images, or a video.
        out: output folder, with a folder for each pair.
        config: options; None for the defaults.
        rig: as for `stereo`.
        progress: called with the progress.
        **options: single options of the config by name, which override it.

    Raises:
        FileFormatError: there are no pairs.
        WorkspaceError: the output folder cannot be used.
    """
    config = options_of(StereoConfig, config, options, ["config", "rig", "progress"])
    left, right = as_path(left), as_path(right)
    work = chosen_executor(None, config.cluster, has_shared_folder=config.shared_folder, default="inline")
    config = replace(config, cluster=None)  # for pairs that are measured here
    job = Job(
        kind="stereo", inputs=(left, right), settings=_settings(config, rig), progress=progress, executor=work
    )
    with open_run(job, as_path(out)) as run:
        pairs = list_pairs(left, right, run.root, config.max_frames, progress)
        settings = partial(_settings, config, rig)
        waiting = {n: pair for n, pair in pairs.items() if not is_measured(run.root / n, pair, settings)}
        units = {} if work == "inline" else _measured_elsewhere(run, waiting, config, rig)
        batch = run_batch(
            pairs,
            waiting,
            run.root,
            partial(_measure_into, units, config, rig),
            ignore_progress if units else progress,
        )
        for unit in units.values():
            unit.path.unlink(missing_ok=True)
        with suppress(OSError):  # it may hold files of the user
            (run.root / UNITS).rmdir()
        for folder in dict.fromkeys((left, right)):
            if folder.is_dir() and (notes := list_photographs(folder, ignore=[run.root]).notes):
                batch.warnings[str(folder)] = tuple(notes)
        summary = summary_of(batch, pairs, read_summary(run.root))
        run.finish(summary)
        return replace(batch, warnings=summary["warnings"])


def _measured_elsewhere(
    run: Run,
    pairs: Mapping[str, tuple[Path, Path]],
    config: StereoConfig,
    rig: RectifiedRig | StereoRig | None,
) -> dict[Path, Unit]:
    """Measure pairs with the run's executor; returns their units by the folder of the pair."""
    units = {
        run.root / name: unit_of_pair(
            run.root, PairPayload(*pair, config, rig), _settings(config, rig, *pair)
        )
        for name, pair in pairs.items()
        if all(image.is_file() for image in pair)
    }
    run.do(list(units.values()), "pairs")
    return units


def _measure_into(
    units: Mapping[Path, Unit],
    config: StereoConfig,
    rig: RectifiedRig | StereoRig | None,
    left: Path,
    right: Path,
    folder: Path,
) -> dict[str, Any]:
    """Write the results of a pair's unit to the pair's folder, or measure the pair here; returns its summary."""
    if (unit := units.get(folder)) is None:
        return summary_of_pair(stereo(left, right, folder, config, rig))
    files, summary = results_of_unit(unit)
    if not files:  # it fails here too, with a reason that names the files of this machine
        return summary_of_pair(stereo(left, right, folder, config, rig))
    job = Job(kind="stereo", inputs=(left, right), settings=_settings(config, rig, left, right))
    with open_run(job, folder) as run:
        with run.folder.publish("stereo") as aside:
            for name, content in files.items():
                path = path_inside(aside, name)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
        run.finish(summary)
    unit.path.unlink()  # so the disk holds only one pair twice
    return summary


@checked
def stereo_of_model(
    workspace: str | Path,
    first: str,
    second: str,
    out: str | Path,
    config: StereoConfig | None = None,
    **options: Unpack[StereoKeywords],
) -> StereoResult:
    """`stereo` for two images of a finished reconstruction, rectified by their poses; depth in the model's unit.

    Args:
        workspace: output folder of `reconstruct`.
        first: name of the image whose pixels get depth, unless it is to the right of the other one.
        second: name of the other image.
        out: output folder.
        config: options.
        **options: single options of the config by name, which override it.

    Raises:
        FileFormatError: there is no model.
        ConfigError: an image is not registered in it.
        DegenerateGeometryError: the two images cannot be rectified.
        WorkspaceError: the output folder cannot be used.
    """
    config, workspace = options_of(StereoConfig, config, options, ["config"]), as_path(workspace)
    _refuse_cluster(config)
    refuse_folder_of(as_path(out), (workspace,))
    model = read_colmap_model(find_model(workspace))
    rows = {name: k for k, name in enumerate(model.images.name)}
    registered, positions = model.is_registered(), model.cams_from_world()
    for name in (first, second):
        if name not in rows or not registered[rows[name]]:
            near = [each for each in rows if Path(each).stem == name]
            hint = f"; did you mean {near[0]}?" if near else ""
            raise ConfigError(f"{name} is not registered in the model in {workspace}{hint}")
    if first == second:
        raise DegenerateGeometryError("the two images of a pair must differ")
    files = ModelImages(model, workspace / "images", is_own=has_own_model(workspace))
    left, right = files.find(first), files.find(second)
    rig = StereoRig(left.camera, right.camera, positions[rows[second]] @ positions[rows[first]].inverse())
    note: tuple[str, ...] = ()
    if is_right_of_left(rig):
        rig, left, right, first, second = rig.swapped(), right, left, second, first
        note = (f"{first} is to the left of {second}, so its pixels get the depth",)
    pair = PairFiles(left.path, right.path, rig, (left.orientation, right.orientation), note)
    settings = _settings(config, rig, left.path, right.path)
    return replace(_measured(pair, as_path(out), config, settings), unit="the model's unit")


@checked
def examine_stereo(
    left: str | Path, right: str | Path, rig: RectifiedRig | StereoRig | None = None, max_frames: int = 8
) -> Diagnosis:
    """Diagnose a pair, or several of one rig: swapped images, misaligned rows, missing synchronization.

    Args:
        left: an image, a folder or a video.
        right: the same for the right camera.
        rig: as for `stereo`.
        max_frames: largest number of pairs examined.

    Raises:
        FileFormatError: an image cannot be read, or there is no pair.
    """
    left, right = as_path(left), as_path(right)
    if max_frames < 1:
        raise ConfigError(f"max_frames must be at least 1, got {max_frames}")
    if not is_many(left, right):
        files = files_of_pair(left, right, rig)
        found = examine([files.read()], files.rig)
        return replace(found, notes=(*found.notes, *files.notes))
    with tempfile.TemporaryDirectory() as scratch:
        pairs = list(list_pairs(left, right, Path(scratch), max_frames).values())
        chosen = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), max_frames)).astype(int))
        read, unread, files = [], [], PairFiles(left, right, rig)
        for k in chosen:
            try:
                files = files_of_pair(pairs[k][0], pairs[k][1], rig)
                read.append(files.read())
            except FileFormatError as error:
                unread.append(str(error))
        if not read:
            raise FileFormatError(left, "none of its pairs can be read")
        found = examine(read, files.rig)
        return replace(found, notes=(*found.notes, *files.notes, *unread))


def _settings(config: StereoConfig, rig: RectifiedRig | StereoRig | None, *images: Path) -> dict[str, Any]:
    """Everything that the result depends on, including the contents of the calibration and the state of the image files."""
    described: Any = asdict(rig) if isinstance(rig, RectifiedRig) else rig
    if isinstance(rig, StereoRig):
        described = {
            "cameras": [[c.model.name, c.width, c.height, c.params.tolist()] for c in (rig.left, rig.right)],
            "right_from_left": rig.right_from_left.as_matrix().tolist(),
            "covariance": None if rig.covariance is None else rig.covariance.tolist(),
        }
    files = [[str(p), p.stat().st_size, p.stat().st_mtime_ns] for p in images if p.is_file()]
    wanted = {name: value for name, value in asdict(config).items() if name not in WHERE}
    return {"config": wanted, "rig": described, "images": files}
