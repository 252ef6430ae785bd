"""Rescue of weakly connected images with learned features, between verification and mapping."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.pipelines.sfm.matching.match_stage import (
    PairWork,
    load_putative,
    load_view_graph,
    verification_units,
)
from epipole.pipelines.sfm.matching.rescue_stage import (
    Choice,
    combined_units,
    learned_match_units,
    learned_units,
    merged,
    rescue_pairs,
    weak_images,
)
from epipole.pipelines.sfm.matching.unit_tables import FEATURES
from epipole.pipelines.sfm.photographs import ImageSet
from epipole.runs import Run, Unit, load
from epipole.scene import ViewGraph


@dataclass(frozen=True, slots=True)
class Rescue:
    """What learned features were used for."""

    images: tuple[int, ...] = ()
    """Images that SIFT connects weakly."""
    num_pairs: int = 0
    """Pairs that are verified only with learned features, or with more matches than without."""


@dataclass(frozen=True, slots=True, eq=False)
class Rescued:
    """Features, matches and pairs, with the learned ones."""

    features: tuple[Unit, ...]
    matches: tuple[Unit, ...]
    """Later units count where a pair is in several."""
    view_graph: ViewGraph
    found: Rescue


def rescue_weak_images(
    images: ImageSet,
    todo: PairWork,
    matches: Sequence[Unit],
    view_graph: ViewGraph,
    folder: Path,
    run: Run,
    config: ReconstructConfig,
) -> Rescued:
    """Match weakly connected images again, with learned features beside SIFT's.

    Args:
        images: the images.
        todo: their pairs, SIFT features and cameras.
        matches: units with SIFT's matches.
        view_graph: verified pairs.
        folder: where files of units go.
        run: executes the units.
        config: the options; `learned` names the folder of weights.
    """
    choice = choice_of(config)
    assert choice is not None
    weak = weak_images(view_graph, len(images))
    counts = num_features(todo.features)
    putative = load_putative(matches, counts)
    pairs = rescue_pairs(weak, todo.pairs, putative)
    if not pairs:
        return Rescued(tuple(todo.features), tuple(matches), view_graph, Rescue())
    members = sorted({i for pair in pairs for i in pair})
    learned = learned_units(images, members, folder / "learned", choice, config.features, config.masks)
    run.do(list(learned.values()), "features")
    combined = combined_units(todo.features, learned, folder / "combined")
    run.do([combined[i] for i in members], "features")
    cameras = {i: todo.cameras[int(todo.camera_of_image[i])] for i in members}
    sizes = {i: (camera.width, camera.height) for i, camera in cameras.items()}
    again = learned_match_units(pairs, learned, todo.features, sizes, putative, folder / "matches")
    run.do(again, "match")
    some = replace(todo, pairs=np.array(pairs, np.int32), features=combined)
    units = verification_units(some, folder / "geometry", again)
    run.do(units, "verify")
    graph, count = merged(view_graph, load_view_graph(units, num_features(combined)))
    rescued = Rescue(tuple(int(i) for i in weak.nonzero()[0]), count)
    return Rescued(combined, (*matches, *again), graph, rescued)


def choice_of(config: ReconstructConfig) -> Choice | None:
    """The network of the options."""
    return None if config.learned is None else Choice(config.learned, config.learned_network)


def num_features(units: Sequence[Unit]) -> list[int]:
    """Number of features of each image."""
    return [len(load(unit.path, FEATURES, "pixels")["pixels"]) for unit in units]
