"""Structure-from-motion from a folder of photographs or a video to models, in stages.

Each stage (images, features, matches, two-view geometries, models) stores its results as files of units of work, from
which an interrupted run continues.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from epipole import _jit
from epipole.mapping import ConflictingPoints
from epipole.mapping.focal_accuracy import FocalAccuracy, focal_accuracies
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.pipelines.sfm.focal import estimate_focals
from epipole.pipelines.sfm.inputs import (
    UNITS,
    detect,
    expansion_of,
    image_set_of,
    in_order,
    keypoints_of,
    open_database,
    pairs_to_match,
)
from epipole.pipelines.sfm.known_poses import contradiction_with_poses, known_poses_of
from epipole.pipelines.sfm.look_alikes import Attempt, Separation, map_apart, map_once
from epipole.pipelines.sfm.mappers.growth import Earlier
from epipole.pipelines.sfm.mapping_stage import Detections, Mapped, map_images
from epipole.pipelines.sfm.matching.database_stage import DatabaseSource
from epipole.pipelines.sfm.matching.database_stage import match_units as given_match_units
from epipole.pipelines.sfm.matching.expansion import PairRounds, expand
from epipole.pipelines.sfm.matching.feature_stage import sift_features
from epipole.pipelines.sfm.matching.match_stage import (
    PairWork,
    match_units,
)
from epipole.pipelines.sfm.matching.pair_selection import ContradictingPairs, consistent_pairs
from epipole.pipelines.sfm.part_stage import in_units
from epipole.pipelines.sfm.photographs import ImageSet
from epipole.pipelines.sfm.rescue import Rescue, choice_of, rescue_weak_images
from epipole.pipelines.sfm.shared_focals import contradicted_cameras, with_cameras_of, with_own_cameras
from epipole.pipelines.sfm.warm_up import warm_up
from epipole.runs import Run, Unit
from epipole.scene import Cameras, ViewGraph

FOCAL_CORRECTION = 0.1
"""Relative change of a trusted focal length by mapping (logarithm) above which matching is repeated."""


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
    later: np.ndarray
    """(q, 2) pairs to match unless their images have many points in common by then."""
    expansion: int
    """Further pairs of each image that verified ones may add."""
    earlier: Earlier | None
    """Models from which the new one grows."""


def solve(source: Path, run: Run, config: ReconstructConfig, earlier: Earlier | None = None) -> Solution:
    """Run all stages: read, detect, match, verify and map.

    Args:
        source: folder of photographs, or a video file.
        run: output folder, executor and progress.
        config: options.
        earlier: models from which the new one grows, if any.

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
        images = image_set_of(source, run, config)
        if earlier is not None and len(earlier.models) > 1:
            images = with_cameras_of(images, earlier.models)
        if config.known_poses is not None:
            sigmas = config.known_poses_sigma_m, config.known_poses_sigma_deg
            images = replace(images, known_poses=known_poses_of(config.known_poses, images.names, *sigmas))
        database, images = open_database(images, run, config)
    with run.stage("features"):
        images, features = detect(images, run, config, database)
        keypoints, colors = keypoints_of(features)
    with run.stage("compile"):
        _wait_for(compiling, run)
    with run.stage("match"):
        given = database.matches(images.names) if database is not None else {}
        run.report("pair", 0, 1)
        pairs = pairs_to_match(images, features, config, given, () if earlier is None else earlier.databases)
        run.report("pair", 1, 1)
    expansion = expansion_of(images, config, is_given=bool(given))
    detected = _Detected(
        features, keypoints, colors, database, given, pairs.first, pairs.later, expansion, earlier
    )
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
    matched, folder = (run.root / UNITS / f"{name}{suffix}" for name in ("matches", "geometry"))
    with run.stage("match"):
        matches = _matches(todo, detected, matched)
        run.do(matches, "match")
    num_features = [len(pixels) for pixels in detected.keypoints]
    rounds = PairRounds((todo,), (tuple(matches),))
    with run.stage("verify"):
        view_graph = rounds.verify(folder, run, num_features)
    with run.stage("expand" if detected.expansion or len(detected.later) else "verify"):
        further = detected.later, detected.expansion
        rounds, view_graph = expand(rounds, view_graph, (matched, folder), run, num_features, *further)
    with run.stage("verify"):
        images = _without_contradictions(images, view_graph, config)
        rounds = rounds.with_cameras(images.cameras, images.camera_of_image)
        cameras, found = estimate_focals(images.cameras, images.camera_of_image, view_graph)
        if found:  # repeat with the estimated focal lengths
            again = folder.with_name(f"{folder.name}-calibrated")
            calibrated = rounds.with_cameras(cameras, images.camera_of_image)
            view_graph = calibrated.verify(again, run, num_features)

    rescued, matches = Rescue(), rounds.all_matches
    detected = replace(detected, pairs=rounds.work.pairs)
    if config.learned is not None:
        with run.stage("rescue"):
            todo = replace(rounds.work, cameras=cameras)
            folder = (
                run.root / UNITS / f"rescue{suffix}"
            )  # a second attempt must not remove what the first one needs
            better = rescue_weak_images(images, todo, matches, view_graph, folder, run, config)
        keypoints, colors = keypoints_of(better.features)
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
    earlier = [() if detected.earlier is None else detected.earlier.models]
    calibrated = replace(images, cameras=cameras)
    map_parts = in_units(run, run.root / UNITS / "parts", config.mapper)
    with_poses_rad = contradiction_with_poses(
        view_graph, images.known_poses, np.deg2rad(config.mapper.max_contradiction_deg)
    )

    def map_pairs(used: Bool[np.ndarray, " n"]) -> Attempt:
        fits_poses = used & np.isnan(with_poses_rad)
        chosen, found_rad = consistent_pairs(
            view_graph.select(fits_poses), detected.keypoints, cameras, images.camera_of_image, config.mapper
        )
        contradiction_rad = np.where(used, with_poses_rad, np.nan)
        contradiction_rad[fits_poses] = found_rad
        start = earlier.pop() if earlier else ()  # an attempt to separate look-alikes starts anew
        mapped = map_images(calibrated, chosen, detections, config.mapper, run.job.progress, start, map_parts)
        return Attempt(mapped, chosen, contradiction_rad)

    return (map_apart if config.mapper.separate_look_alikes else map_once)(
        view_graph, map_pairs, detected.pairs
    )


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
    requested = {pair: detected.given[pair] for pair in in_order(todo.pairs)}
    return given_match_units(requested, folder)


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
