"""What matching starts from: images, their features, a database, and the pairs of images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import overload

import numpy as np

from epipole.errors import ConfigError, NoModelError
from epipole.io.contents_in_words import with_what_it_is
from epipole.io.images.video import extract_frames, frame_orientation, is_video
from epipole.io.workspaces import DATABASE
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.pipelines.sfm.matching.database_stage import DatabaseSource, open_source
from epipole.pipelines.sfm.matching.database_stage import feature_units as given_feature_units
from epipole.pipelines.sfm.matching.feature_stage import feature_units
from epipole.pipelines.sfm.matching.pairing import (
    ChosenPairs,
    EarlierDatabase,
    choose_pairs,
    further_pairs,
    method_of,
    read_pairs,
)
from epipole.pipelines.sfm.matching.unit_tables import FEATURES
from epipole.pipelines.sfm.photographs import ImageSet, read_image_set
from epipole.runs import Run, Unit, load

UNITS, FRAMES = "work", "work/frames"
CONTENTS = "work/contents.npz"
"""Paths in the output folder."""


def image_set_of(source: Path, run: Run, config: ReconstructConfig) -> ImageSet:
    """The images of a folder, or frames of a video.

    Raises:
        NoModelError: there are none.
        ConfigError: options do not match the images.
    """
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


def open_database(
    images: ImageSet, run: Run, config: ReconstructConfig
) -> tuple[DatabaseSource | None, ImageSet]:
    """Open the given database, if any; also returns the images that it has."""
    if config.database is None:
        return None, images
    if config.database.resolve() == (run.root / DATABASE).resolve():
        raise ConfigError(f"{config.database} is overwritten by this run; copy it elsewhere first")
    source, images = open_source(config.database, images, keep_cameras=config.has_known_camera)
    if (np.diff(source.contents.rigs.sensor_offsets) > 1).any():
        run.warnings.append(
            f"the rigs in {config.database.name} are not used, and its images are mapped one by one: to use rigs, pass --rigs instead of --database"
        )
    return source, images


def detect(
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


def keypoints_of(features: Sequence[Unit]) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Pixels (k, 2) and colors (k, 3) of the features of each image."""
    stored = [load(unit.path, FEATURES, "pixels", "colors") for unit in features]
    return tuple(s["pixels"].astype(np.float64) for s in stored), tuple(s["colors"] for s in stored)


def pairs_to_match(
    images: ImageSet,
    features: Sequence[Unit],
    config: ReconstructConfig,
    given: dict[tuple[int, int], np.ndarray],
    earlier: Sequence[EarlierDatabase] = (),
) -> ChosenPairs:
    """Pairs to match: the requested ones, restricted to pairs with given matches, if there are any."""
    requested = read_pairs(config.pairs, images.names) if config.pairs is not None else None
    if given:
        kept = sorted(given) if requested is None else [p for p in in_order(requested) if p in given]
        return ChosenPairs(np.array(kept, np.int32).reshape(-1, 2))
    if requested is not None:
        return ChosenPairs(requested)
    descriptors = descriptors_on_access([u.path for u in features])
    if earlier:
        keypoints, _ = keypoints_of(features)
        return ChosenPairs(
            further_pairs(descriptors, keypoints, images.names, earlier, config.pairing.neighbors)
        )
    return choose_pairs(
        descriptors,
        images.lat_lon_alt,
        config.pairing,
        is_video=images.is_video,
        names=images.names,
        taken_s=images.taken_s,
    )


def expansion_of(images: ImageSet, config: ReconstructConfig, *, is_given: bool) -> int:
    """Further pairs of each image that verified ones may add: none to pairs that were requested or that are near in time."""
    method = method_of(images.lat_lon_alt, config.pairing, is_video=images.is_video)
    is_chosen = config.pairs is None and not is_given and method in ("spatial", "retrieval")
    return config.pairing.expansion if is_chosen else 0


def in_order(pairs: np.ndarray) -> list[tuple[int, int]]:
    """Unique pairs (i, j), i < j, sorted."""
    return sorted({(int(min(pair)), int(max(pair))) for pair in pairs})


def descriptors_on_access(paths: Sequence[Path]) -> Sequence[np.ndarray]:
    """Descriptors that are read from the files of features on access: exhaustive pairing needs none, and those of thousands of images do not fit in memory."""
    return _Descriptors(list(paths))


class _Descriptors(Sequence[np.ndarray]):
    def __init__(self, paths: list[Path]) -> None:
        self._paths = paths

    def __len__(self) -> int:
        return len(self._paths)

    @overload
    def __getitem__(self, index: int) -> np.ndarray: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[np.ndarray]: ...
    def __getitem__(self, index: int | slice) -> np.ndarray | Sequence[np.ndarray]:
        if isinstance(index, slice):
            return _Descriptors(self._paths[index])
        return load(self._paths[index], FEATURES, "descriptors")["descriptors"]
