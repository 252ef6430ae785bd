"""Structure-from-motion from a folder of photographs or a video to models, in stages.

Each stage (images, features, matches, two-view geometries, models) stores its results as files of units of work, from
which an interrupted run continues.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from epipole import _jit
from epipole.errors import ConfigError, NoModelError
from epipole.io.contents_in_words import with_what_it_is
from epipole.io.images.video import extract_frames, frame_orientation, is_video
from epipole.mapping import ConflictingPoints
from epipole.mapping.focal_accuracy import FocalAccuracy, focal_accuracies
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.pipelines.sfm.focal import estimate_focals
from epipole.pipelines.sfm.look_alikes import Attempt, Separation, map_apart, map_once
from epipole.pipelines.sfm.mapping_stage import Detections, Mapped, map_images
from epipole.pipelines.sfm.matching.database_stage import DatabaseSource, open_source
from epipole.pipelines.sfm.matching.database_stage import feature_units as given_feature_units
from epipole.pipelines.sfm.matching.database_stage import match_units as given_match_units
from epipole.pipelines.sfm.matching.feature_stage import feature_units, sift_features
from epipole.pipelines.sfm.matching.match_stage import (
    PairWork,
    load_view_graph,
    match_units,
    verification_units,
)
from epipole.pipelines.sfm.matching.pair_selection import ContradictingPairs, consistent_pairs
from epipole.pipelines.sfm.matching.pairing import choose_pairs, read_pairs
from epipole.pipelines.sfm.matching.unit_tables import FEATURES
from epipole.pipelines.sfm.photographs import ImageSet, read_image_set
from epipole.pipelines.sfm.rescue import Rescue, choice_of, rescue_weak_images
from epipole.pipelines.sfm.shared_focals import contradicted_cameras, with_own_cameras
from epipole.pipelines.sfm.warm_up import warm_up
from epipole.runs import Run, Unit, load
from epipole.scene import Cameras, ViewGraph

FOCAL_CORRECTION = 0.1
"""Relative change of a trusted focal length by mapping (logarithm) above which matching is repeated."""
UNITS, FRAMES, DATABASE = "work", "work/frames", "database.db"
CONTENTS = "work/contents.npz"
"""Paths in the output folder."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Matches, geometries and models, computed with one set of intrinsics."""

    images: ImageSet
    features: tuple[Unit, ...]
    keypoints: tuple[np.ndarray, ...]
    matches: tuple[Unit, ...]
    cameras: Cameras
    view_graph: ViewGraph
    guessed_cameras: tuple[int, ...]
    """Cameras whose focal lengths were estimated from the images; `cameras` has the estimates."""
    mapped: Mapped
    contradicting: ContradictingPairs
    """Verified pairs that are not used, because they contradict the others or hold models together whose points conflict."""
    conflicts: tuple[ConflictingPoints, ...]
    """For each model, points that exclude each other."""
    rescue: Rescue
    """What learned features were used for."""
    focals: Mapping[int, FocalAccuracy] = field(default_factory=dict)
    """Accuracy of each camera's focal length in the models, by row."""

    def with_focals(self) -> Solution:
        """Copy with the accuracy of the focal lengths, each from the largest model with that camera."""
        found: dict[int, FocalAccuracy] = {}
        for model in self.mapped.models:
            found = {**focal_accuracies(model), **found}
        return replace(self, focals=dict(sorted(found.items())))

    def worth(self) -> tuple[int, int]:
        """Number of images and observations of the largest model."""
        if not self.mapped.models:
            return 0, 0
        return int(self.mapped.models[0].is_registered().sum()), len(self.mapped.models[0].tracks.image)


@dataclass(frozen=True, slots=True, eq=False)
class _Detected:
    """Input of matching."""

    features: tuple[Unit, ...]
    keypoints: tuple[np.ndarray, ...]
    colors: tuple[np.ndarray, ...]
    database: DatabaseSource | None
    given: dict[tuple[int, int], np.ndarray]
    """Matches of the database; empty if they are to be computed."""
    pairs: np.ndarray
    """(p, 2) pairs of images to match."""


def solve(source: Path, run: Run, config: ReconstructConfig) -> Solution:
    """Run all stages: read, detect, match, verify and map.

    Args:
        source: folder of photographs, or a video file.
        run: output folder, executor and progress.
        config: options.

    Raises:
        NoModelError: there are no usable images. A solution without a model is not an error here.
        ConfigError: options do not match the images.
        FileFormatError: the folder of learned features cannot be used.
        MissingDependencyError: learned features need onnxruntime.
    """
    if (choice := choice_of(config)) is not None:
        choice.load()  # an unusable folder is reported before any work
    compiling = threading.Thread(target=warm_up, name="epipole-compile", daemon=True)
    compiling.start()
    with run.stage("read"):
        images = _read(source, run, config)
        database, images = _open_database(images, run, config)
    with run.stage("features"):
        images, features = _detect(images, run, config, database)
        keypoints, colors = _keypoints(features)
    with run.stage("compile"):
        _wait_for(compiling, run)
    with run.stage("match"):
        given = database.matches(images.names) if database is not None else {}
        run.report("pair", 0, 1)
        pairs = _choose_pairs(images, features, config, given)
        run.report("pair", 1, 1)
    detected = _Detected(features, keypoints, colors, database, given, pairs)
    solution = _match_and_map(images, detected, run, config)
    if (corrected := _corrected_cameras(solution)) is not None:
        images = replace(solution.images, cameras=corrected)
        again = _match_and_map(images, detected, run, config, "-again")
        solution = max(solution, again, key=Solution.worth)
        run.report("map", solution.mapped.num_registered(), len(images))
    return solution


def _match_and_map(
    images: ImageSet, detected: _Detected, run: Run, config: ReconstructConfig, suffix: str = ""
) -> Solution:
    """Match, verify and map with the given intrinsics."""
    todo = PairWork(
        detected.pairs,
        detected.features,
        images.cameras,
        images.camera_of_image,
        config.matching,
        config.verification,
    )
    with run.stage("match"):
        matches = _matches(todo, detected, run.root / UNITS / f"matches{suffix}")
        run.do(matches, "match")
    num_features = [len(pixels) for pixels in detected.keypoints]
    with run.stage("verify"):
        folder = run.root / UNITS / f"geometry{suffix}"
        view_graph = _verify(todo, matches, folder, run, num_features)
        images = _without_contradictions(images, view_graph, config)
        todo = replace(todo, cameras=images.cameras, camera_of_image=images.camera_of_image)
        cameras, found = estimate_focals(todo.cameras, todo.camera_of_image, view_graph)
        if found:  # repeat with the estimated focal lengths
            again = folder.with_name(f"{folder.name}-calibrated")
            view_graph = _verify(replace(todo, cameras=cameras), matches, again, run, num_features)

    rescued = Rescue()
    if config.learned is not None:
        with run.stage("rescue"):
            todo = replace(todo, cameras=cameras)
            folder = (
                run.root / UNITS / f"rescue{suffix}"
            )  # a second attempt must not remove what the first one needs
            better = rescue_weak_images(images, todo, matches, view_graph, folder, run, config)
        keypoints, colors = _keypoints(better.features)
        detected = replace(detected, features=better.features, keypoints=keypoints, colors=colors)
        matches, view_graph, rescued = list(better.matches), better.view_graph, better.found
    with run.stage("map"):
        separated = _map(images, cameras, view_graph, detected, run, config)
    return Solution(
        images,
        detected.features,
        detected.keypoints,
        tuple(matches),
        cameras,
        separated.last.view_graph,
        tuple(found),
        separated.last.mapped,
        separated.contradicting,
        separated.conflicts,
        rescued,
    )


def _map(
    images: ImageSet,
    cameras: Cameras,
    view_graph: ViewGraph,
    detected: _Detected,
    run: Run,
    config: ReconstructConfig,
) -> Separation:
    """Map the pairs that contradict neither the others nor the model."""
    detections = Detections(detected.keypoints, detected.colors, sift_features(detected.features))

    def map_pairs(used: Bool[np.ndarray, " n"]) -> Attempt:
        chosen, found_rad = consistent_pairs(
            view_graph.select(used), detected.keypoints, cameras, images.camera_of_image, config.mapper
        )
        contradiction_rad = np.full(len(used), np.nan)
        contradiction_rad[used] = found_rad
        mapped = map_images(images, cameras, chosen, detections, config.mapper, run.job.progress)
        return Attempt(mapped, chosen, contradiction_rad)

    return (map_apart if config.mapper.separate_look_alikes else map_once)(view_graph, map_pairs)


def _without_contradictions(images: ImageSet, view_graph: ViewGraph, config: ReconstructConfig) -> ImageSet:
    """Give each image its own camera if the images of a camera without EXIF cannot share a focal length."""
    wrong = contradicted_cameras(images.cameras, images.camera_of_image, view_graph)
    if not wrong:
        return images
    intrinsics = [images.cameras[c] for c in wrong]
    sizes = ", ".join(f"{camera.width}x{camera.height}" for camera in intrinsics)
    if config.single_camera or images.is_video:
        why = "single_camera" if config.single_camera else "a video"
        note = (
            f"the images of {sizes} contradict one shared focal length, as required by {why}: if the zoom changed, or"
            " there are several cameras, the models are distorted"
        )
        return replace(images, notes=(*images.notes, note) if note not in images.notes else images.notes)
    cameras, camera_of_image = with_own_cameras(images.cameras, images.camera_of_image, wrong)
    first = {int(c): int(images.camera_of_image[row]) for row, c in enumerate(camera_of_image)}
    counts = [int((images.camera_of_image == c).sum()) for c in wrong]
    note = (
        f"{sum(counts)} images of {sizes} without a known focal length contradict a shared one:"
        " each gets its own camera"
    )
    sources = tuple(images.focal_sources[first.get(c, c)] for c in range(len(cameras)))
    return replace(
        images,
        cameras=cameras,
        camera_of_image=camera_of_image,
        focal_sources=sources,
        notes=(*images.notes, note),
    )


def _matches(todo: PairWork, detected: _Detected, folder: Path) -> list[Unit]:
    if detected.database is None or not detected.given:
        return match_units(todo, folder)
    requested = {pair: detected.given[pair] for pair in _in_order(todo.pairs)}
    return given_match_units(requested, folder)


def _verify(
    todo: PairWork, matches: Sequence[Unit], folder: Path, run: Run, num_features: Sequence[int]
) -> ViewGraph:
    units = verification_units(todo, folder, matches)
    run.do(units, "verify")
    return load_view_graph(units, num_features)


def _wait_for(compiling: threading.Thread, run: Run) -> None:
    if _jit.is_compiled():
        compiling.join()
        return
    run.report("compile", 0, 1)
    compiling.join()
    run.report("compile", 1, 1)


def _corrected_cameras(found: Solution) -> Cameras | None:
    """Cameras as refined by mapping, if a trusted focal length was wrong and images are missing; else None.

    Such a focal length has corrupted matches and geometries before a model could correct it.
    """
    first = found.images.cameras
    if not found.mapped.models:
        return None
    model = found.mapped.models[0]
    used = np.zeros(len(first), bool)
    used[model.camera_of_image[model.is_registered()]] = True
    ratio = model.cameras.params[:, 0] / first.params[:, 0]
    wrong = used & first.is_focal_trusted & ~first.is_constant & (np.abs(np.log(ratio)) > FOCAL_CORRECTION)
    if not wrong.any() or model.is_registered().sum() < 5 or model.is_registered().all():
        return None
    return replace(first, params=np.where(wrong[:, None], model.cameras.params, first.params))


def _read(source: Path, run: Run, config: ReconstructConfig) -> ImageSet:
    memory = run.root / CONTENTS
    if is_video(source):
        if config.include or config.exclude:
            raise ConfigError(f"include and exclude select images of a folder, but {source} is a video")
        folder = run.root / FRAMES
        frames = extract_frames(
            source,
            folder,
            max_frames=config.max_frames,
            progress=lambda done, total: run.report("video", done, total),
        )
        times = dict(zip(frames.name, (float(t) for t in frames.timestamp_s)))
        orientation = frame_orientation(source) if config.has_known_camera else 1
        return read_image_set(
            folder,
            config,
            memory,
            timestamps_s=times,
            video_orientation=orientation,
            progress=run.job.progress,
        )
    if not source.is_dir():
        problem = f"{source} is neither a video nor a folder"
        raise NoModelError(with_what_it_is(problem, source, "give the folder that holds the photographs"))
    ignore = (run.root, *((config.masks,) if config.masks else ()))
    return read_image_set(source, config, memory, ignore=ignore, progress=run.job.progress)


def _open_database(
    images: ImageSet, run: Run, config: ReconstructConfig
) -> tuple[DatabaseSource | None, ImageSet]:
    """Open the given database, if any; also returns the images that it has."""
    if config.database is None:
        return None, images
    if config.database.resolve() == (run.root / DATABASE).resolve():
        raise ConfigError(f"{config.database} is overwritten by this run; copy it elsewhere first")
    return open_source(config.database, images, keep_cameras=config.has_known_camera)


def _detect(
    images: ImageSet, run: Run, config: ReconstructConfig, database: DatabaseSource | None
) -> tuple[ImageSet, tuple[Unit, ...]]:
    """Features of every image, detected or from the database; damaged images are removed from the set."""
    folder = run.root / UNITS / "features"
    if database is None:
        units = feature_units(images, folder, config.features, config.masks)
    else:
        units = given_feature_units(database, images, folder, config.features.max_size_px)
    run.do(units, "features")
    failures = {}
    for i, unit in enumerate(units):
        if why := str(load(unit.path, FEATURES, "failure")["failure"]):
            failures[i] = why
    images = images.without(failures)
    if len(images) == 0:
        reason = next(iter(images.left_out.values()))
        raise NoModelError(f"none of the images can be used ({reason})")
    if len(images) < 2:
        left_out = "".join(f"; {name}: {why}" for name, why in list(images.left_out.items())[:3])
        raise NoModelError(f"only one usable image, and one image cannot give depth{left_out}")
    return images, tuple(u for i, u in enumerate(units) if i not in failures)


def _keypoints(features: Sequence[Unit]) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    stored = [load(unit.path, FEATURES, "pixels", "colors") for unit in features]
    return tuple(s["pixels"].astype(np.float64) for s in stored), tuple(s["colors"] for s in stored)


def _choose_pairs(
    images: ImageSet,
    features: Sequence[Unit],
    config: ReconstructConfig,
    given: dict[tuple[int, int], np.ndarray],
) -> np.ndarray:
    """Pairs to match: the requested ones, restricted to pairs with given matches, if there are any."""
    requested = read_pairs(config.pairs, images.names) if config.pairs is not None else None
    if given:
        kept = sorted(given) if requested is None else [p for p in _in_order(requested) if p in given]
        return np.array(kept, np.int32).reshape(-1, 2)
    if requested is not None:
        return requested
    descriptors = _Descriptors([u.path for u in features])
    return choose_pairs(descriptors, images.lat_lon_alt, config.pairing, is_video=images.is_video)


def _in_order(pairs: np.ndarray) -> list[tuple[int, int]]:
    return sorted({(int(min(pair)), int(max(pair))) for pair in pairs})


class _Descriptors(Sequence[np.ndarray]):
    """Descriptors that are read from disk on access, since exhaustive pairing needs none."""

    def __init__(self, paths: list[Path]) -> None:
        self._paths = paths

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        return load(self._paths[index], FEATURES, "descriptors")["descriptors"]
