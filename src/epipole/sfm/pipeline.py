"""Structure-from-motion from a folder of photographs (or a video) to models on disk."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from epipole import _jit, _parallel
from epipole.config import ReconstructConfig
from epipole.errors import ConfigError, NoModelError
from epipole.io.colmap import write_colmap_model
from epipole.io.colmap_database import DatabaseContents, write_database
from epipole.io.photographs import copy_or_rotate
from epipole.io.ply import write_scene_ply
from epipole.io.video import extract_frames, is_video
from epipole.scene import Cameras, Frames, Images, Reconstruction, Rigs, ViewGraph, unregistered
from epipole.sfm.database_stage import DatabaseSource, Matches, open_source
from epipole.sfm.database_stage import feature_units as given_feature_units
from epipole.sfm.database_stage import match_units as given_match_units
from epipole.sfm.feature_stage import feature_units
from epipole.sfm.focal import estimate_focals
from epipole.sfm.mapping_stage import Mapped, map_images, no_model_reason, reasons_in_words
from epipole.sfm.match_stage import PairWork, load_putative, load_view_graph, match_units, verification_units
from epipole.sfm.pairing import choose_pairs, read_pairs
from epipole.sfm.photographs import ImageSet, read_image_set
from epipole.sfm.warm_up import warm_up
from epipole.sfm.workspace import Workspace, open_workspace
from epipole.workflow import Progress, ProgressCallback, Unit, ignore_progress, load, run_units, timed

FOCAL_CORRECTION = 0.1
"""A trusted focal length that changes by more in mapping was wrong: matching starts again with the better one."""


@dataclass(frozen=True, slots=True, eq=False)
class PipelineResult:
    """Everything a report needs to know about a run."""

    workspace: Workspace
    images: ImageSet
    view_graph: ViewGraph
    mapped: Mapped
    reasons: dict[str, str]
    """Why each picture without a place has none."""
    num_keypoints: tuple[int, ...]
    feature_files: tuple[Path, ...]
    warnings: tuple[str, ...]
    timings_s: dict[str, float]

    @property
    def models(self) -> tuple[Reconstruction, ...]:
        """Largest first."""
        return self.mapped.models


def run_pipeline(
    source: Path, out: Path, config: ReconstructConfig, progress: ProgressCallback = ignore_progress
) -> PipelineResult:
    """Read, detect, match, verify, map and write; each stage resumes from what the output folder holds.

    Args:
        source: folder of photographs, or a video file.
        out: the output folder; made if missing.
        config: options.
        progress: called from the calling thread.

    Raises:
        NoModelError: there are no usable pictures, or they give no depth; the message says why.
        WorkspaceError: the output folder cannot be used.
        ConfigError: options that do not fit the pictures.
    """
    timings_s: dict[str, float] = {}
    if not source.exists():
        raise NoModelError(f"{source} does not exist")
    workspace = open_workspace(out, str(source.resolve()))
    compiling = threading.Thread(target=warm_up, name="epipole-compile", daemon=True)
    compiling.start()
    with _parallel.single_threaded_blas():
        with timed(timings_s, "read"):
            images = _read(source, workspace, config, progress)
            database, images = _open_database(images, workspace, config)
        with timed(timings_s, "features"):
            images, features = _detect(images, workspace, config, progress, database)
        with timed(timings_s, "compile"):
            _wait_for(compiling, progress)
        with timed(timings_s, "match"):
            given = database.matches(images.names) if database is not None else {}
            pairs = _choose_pairs(images, features, config, given)
        keypoints, colors = _keypoints(features)

        def attempt(images: ImageSet, suffix: str) -> _Attempt:
            of_images = images.cameras, images.camera_of_image
            todo = PairWork(pairs, features, *of_images, config.matching, config.verification)
            with timed(timings_s, "match"):
                folder = workspace.units / f"matches{suffix}"
                if database is not None and given:
                    matches = given_match_units(database, {p: given[p] for p in _in_order(pairs)}, folder)
                else:
                    matches = match_units(todo, folder)
                run_units(matches, stage="match", executor=config.executor, progress=progress)
            with timed(timings_s, "verify"):
                folder = workspace.units / f"geometry{suffix}"
                cameras, view_graph, notes = _verify(todo, matches, folder, config, progress)
            with timed(timings_s, "map"):
                mapped = map_images(images, cameras, view_graph, keypoints, colors, config.mapper, progress)
            return _Attempt(images, matches, cameras, view_graph, notes, mapped)

        best = attempt(images, "")
        if (corrected := _corrected_cameras(best)) is not None:
            best = max(best, attempt(replace(images, cameras=corrected), "-again"), key=_Attempt.worth)
        images, view_graph, mapped = best.images, best.view_graph, best.mapped
        reasons = reasons_in_words(images, mapped, view_graph, keypoints, config.mapper.resection_min_inliers)
        with timed(timings_s, "write"):
            _write_database(workspace, best, keypoints, features)
            if not mapped.models:
                raise NoModelError(no_model_reason(view_graph, len(images)))
            _write_models(workspace, images, mapped)
    return PipelineResult(
        workspace,
        images,
        view_graph,
        mapped,
        reasons,
        tuple(len(k) for k in keypoints),
        tuple(u.path for u in features),
        (*best.notes, *_warnings(images, mapped, reasons, config.mapper.sound_end_share)),
        timings_s,
    )


def _wait_for(compiling: threading.Thread, progress: ProgressCallback) -> None:
    if _jit.is_compiled():
        compiling.join()
        return
    progress(Progress("compile", 0, 1))
    compiling.join()
    progress(Progress("compile", 1, 1))


@dataclass(frozen=True, slots=True, eq=False)
class _Attempt:
    """Matching, verification and mapping under one idea of the cameras."""

    images: ImageSet
    matches: list[Unit]
    cameras: Cameras
    view_graph: ViewGraph
    notes: tuple[str, ...]
    mapped: Mapped

    def worth(self) -> tuple[int, int]:
        """Images and observations of the largest model."""
        if not self.mapped.models:
            return 0, 0
        return int(self.mapped.models[0].is_registered().sum()), len(self.mapped.models[0].tracks.image)


def _corrected_cameras(attempt: _Attempt) -> Cameras | None:
    """The cameras as mapping found them, where a trusted focal length was wrong and images are missing; else None.

    Such a focal length has spoiled matches and geometries before any model could correct it.
    """
    first = attempt.images.cameras
    if not attempt.mapped.models:
        return None
    model = attempt.mapped.models[0]
    used = np.zeros(len(first), bool)
    used[model.camera_of_image[model.is_registered()]] = True
    ratio = model.cameras.params[:, 0] / first.params[:, 0]
    wrong = used & first.is_focal_trusted & ~first.is_constant & (np.abs(np.log(ratio)) > FOCAL_CORRECTION)
    if not wrong.any() or model.is_registered().sum() < 5 or model.is_registered().all():
        return None
    return replace(first, params=np.where(wrong[:, None], model.cameras.params, first.params))


def _read(
    source: Path, workspace: Workspace, config: ReconstructConfig, progress: ProgressCallback
) -> ImageSet:
    if is_video(source):
        frames = extract_frames(
            source,
            workspace.frames,
            max_frames=config.max_frames,
            progress=lambda done, total: progress(Progress("video", done, total)),
        )
        times = dict(zip(frames.name, (float(t) for t in frames.timestamp_s)))
        return read_image_set(workspace.frames, config, timestamps_s=times, progress=progress)
    if not source.is_dir():
        raise NoModelError(f"{source} is neither a folder of photographs nor a video")
    ignore = (workspace.root, *((config.masks,) if config.masks else ()))
    return read_image_set(source, config, ignore=ignore, progress=progress)


def _open_database(
    images: ImageSet, workspace: Workspace, config: ReconstructConfig
) -> tuple[DatabaseSource | None, ImageSet]:
    """The database to start from, where one is given, and the pictures that it knows."""
    if config.database is None:
        return None, images
    if config.database.resolve() == workspace.database.resolve():
        raise ConfigError(f"{config.database} is where this run writes its own; copy it elsewhere first")
    return open_source(config.database, images, keep_cameras=config.camera_params is not None)


def _detect(
    images: ImageSet,
    workspace: Workspace,
    config: ReconstructConfig,
    progress: ProgressCallback,
    database: DatabaseSource | None,
) -> tuple[ImageSet, list[Unit]]:
    """Features of every picture, found or from the database; damaged pictures leave the set."""
    folder = workspace.units / "features"
    if database is None:
        units = feature_units(images, folder, config.features, config.masks)
    else:
        units = given_feature_units(database, images, folder, config.features.max_size_px)
    run_units(units, stage="features", executor=config.executor, progress=progress)
    failures = {}
    for i, unit in enumerate(units):
        if why := str(load(unit.path, "failure")["failure"]):
            failures[i] = why
    images = images.without(failures)
    if len(images) == 0:
        reason = next(iter(images.left_out.values()))
        raise NoModelError(f"none of the pictures can be read ({reason})")
    if len(images) < 2:
        left_out = "".join(f"; {name}: {why}" for name, why in list(images.left_out.items())[:3])
        raise NoModelError(f"only one usable picture, and one picture cannot give depth{left_out}")
    return images, [u for i, u in enumerate(units) if i not in failures]


def _choose_pairs(
    images: ImageSet, features: Sequence[Unit], config: ReconstructConfig, given: Matches
) -> np.ndarray:
    """The pairs to work on; of those with given matches, where there are any, the ones asked for."""
    asked = read_pairs(config.pairs, images.names) if config.pairs is not None else None
    if given:
        kept = sorted(given) if asked is None else [p for p in _in_order(asked) if p in given]
        return np.array(kept, np.int32).reshape(-1, 2)
    if asked is not None:
        return asked
    descriptors = _Lazy([u.path for u in features])
    return choose_pairs(descriptors, images.lat_lon_alt, config.pairing, is_video=images.is_video)


def _in_order(pairs: np.ndarray) -> list[tuple[int, int]]:
    return sorted({(int(min(pair)), int(max(pair))) for pair in pairs})


class _Lazy(Sequence[np.ndarray]):
    """Descriptors read from disk when asked for: exhaustive pairing asks for none."""

    def __init__(self, paths: list[Path]) -> None:
        self._paths = paths

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        return load(self._paths[index], "descriptors")["descriptors"]


def _verify(
    todo: PairWork,
    matches: Sequence[Unit],
    folder: Path,
    config: ReconstructConfig,
    progress: ProgressCallback,
) -> tuple[Cameras, ViewGraph, tuple[str, ...]]:
    """Geometry of all pairs; where focal lengths were guessed, again with those that the pairs agree on."""

    def verify(cameras: Cameras, folder: Path) -> ViewGraph:
        units = verification_units(replace(todo, cameras=cameras), folder, matches)
        run_units(units, stage="verify", executor=config.executor, progress=progress)
        return load_view_graph(units)

    view_graph = verify(todo.cameras, folder)
    cameras, found = estimate_focals(todo.cameras, todo.camera_of_image, view_graph)
    if not found:
        return cameras, view_graph, ()
    notes = tuple(
        f"camera {c + 1}: focal length {cameras[c].focal_px:.0f} px estimated from the pictures themselves"
        for c in found
    )
    return cameras, verify(cameras, folder.with_name(f"{folder.name}-calibrated")), notes


def _keypoints(features: Sequence[Unit]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    keypoints, colors = [], []
    for unit in features:
        with np.load(unit.path) as stored:
            keypoints.append(stored["pixels"].astype(np.float64))
            colors.append(stored["colors"])
    return keypoints, colors


def _write_database(
    workspace: Workspace, attempt: _Attempt, keypoints: Sequence[np.ndarray], features: Sequence[Unit]
) -> None:
    images, cameras = attempt.images, attempt.cameras
    n = len(images)
    offsets = np.concatenate([[0], np.cumsum([len(k) for k in keypoints])]).astype(np.int64)
    stacked = np.concatenate(list(keypoints)).reshape(-1, 2)
    rows = np.arange(n, dtype=np.int32)
    descriptors = []
    for unit in features:
        with np.load(unit.path) as stored:
            descriptors.append(stored["descriptors"] if stored["descriptors"].shape[1] == 128 else None)
    contents = DatabaseContents(
        cameras,
        Rigs.of_single_cameras(len(cameras)),
        Frames(images.camera_of_image, unregistered(n), images.timestamps_s),
        Images(images.names, rows, images.camera_of_image, offsets, stacked),
        descriptors,
        load_putative(attempt.matches),
        attempt.view_graph,
        images.lat_lon_alt,
    )
    write_database(workspace.database, contents)


def _write_models(workspace: Workspace, images: ImageSet, mapped: Mapped) -> None:
    for number, model in enumerate(mapped.models):
        write_colmap_model(model, workspace.sparse / str(number))
    number = len(mapped.models)
    while (stale := workspace.sparse / str(number)).is_dir():
        for file in stale.iterdir():
            file.unlink()
        stale.rmdir()
        number += 1
    write_scene_ply(workspace.root / "points.ply", mapped.models[0])
    registered = np.zeros(len(images), bool)
    for model in mapped.models:
        registered |= model.is_registered()
    for image in np.flatnonzero(registered):
        source, target = images.folder / images.names[image], workspace.images / images.names[image]
        if not target.is_file() or target.stat().st_mtime_ns < source.stat().st_mtime_ns:
            copy_or_rotate(source, target)


def _warnings(
    images: ImageSet, mapped: Mapped, reasons: dict[str, str], sound_share: float
) -> tuple[str, ...]:
    out = []
    for number, agreement in enumerate(mapped.agreements):
        if agreement < sound_share:
            out.append(
                f"model {number} agrees with only {100 * agreement:.0f} % of its own matches: "
                "parts of it are probably wrong (a wrong focal length, or things that look alike)"
            )
    if reasons:
        out.append(f"{len(reasons)} of {len(images) + len(images.left_out)} pictures are in no model")
    if len(mapped.models) > 1:
        counts = ", ".join(str(int(m.is_registered().sum())) for m in mapped.models)
        out.append(
            f"the pictures fall into {len(mapped.models)} models that do not connect ({counts} pictures)"
        )
    return tuple(out)
