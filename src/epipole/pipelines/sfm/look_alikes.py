"""Mapping where different things look alike: pairs of images whose points conflict in a model do not hold it together.

A model that shows different things as one agrees with its matches, so that only what surrounds the like parts gives it away. The images
are clustered by their conflicts, and mapped again without the pairs that hold different clusters together as in the model. Other
pairs then decide where the clusters belong. If none do, each cluster becomes a separate model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.sparse import csr_matrix

from epipole.geometry import Rotation3
from epipole.mapping import ConflictingPoints, cluster_images, find_conflicting_points
from epipole.pipelines.sfm.mapping_stage import Mapped
from epipole.pipelines.sfm.matching.pair_selection import ContradictingPairs
from epipole.scene import Reconstruction, ViewGraph

MAX_ROUNDS, MAX_SPLITS = 6, 3
"""Times that images are mapped again before they are mapped apart, and times that they are."""
MIN_PAIRS_AGAIN, MAX_CONTRADICTING_AGAIN = 3, 0.1
"""Number and fraction of the pairs with conflicts in a model of a later round that are enough to doubt it."""
DISAGREES_RAD = np.deg2rad(25.0)
"""Angle between a pair's rotation and that of the model beyond which the pair does not hold the model together."""
CLEAR_EVIDENCE = 10.0
"""Logarithm of the likelihood ratio of a pair that certainly shows different things."""
LEAST_IMAGES = 4
"""Images of a cluster that is mapped apart; what fewer images show says too little about their poses."""


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """Models from some of the pairs."""

    mapped: Mapped
    view_graph: ViewGraph
    """The pairs that were used."""
    contradiction_rad: Float64[np.ndarray, " n"]
    """For each verified pair whose rotation contradicts the others, the angle; NaN for the others."""


@dataclass(frozen=True, slots=True, eq=False)
class Separation:
    """Models, and the pairs that were left out because their images show different things."""

    last: Attempt
    conflicts: tuple[ConflictingPoints, ...]
    """Of each model."""
    contradicting: ContradictingPairs
    """The verified pairs that the models do not use."""
    is_split: bool = False
    """Whether clusters of images were mapped apart."""


def map_apart(view_graph: ViewGraph, map_pairs: Callable[[Bool[np.ndarray, " n"]], Attempt]) -> Separation:
    """Map the images; while points of a model conflict, map them again without the pairs that hold it together.

    Args:
        view_graph: verified pairs.
        map_pairs: maps the images with the pairs of a mask.
    """
    used, fraction = np.ones(len(view_graph), bool), np.full(len(view_graph), np.nan)
    is_split, found = False, map_once(view_graph, map_pairs)
    for num_rounds in range(MAX_ROUNDS + MAX_SPLITS):
        models, rotation = found.last.mapped.models, view_graph.cam2_from_cam1.rotation.copy()
        # A plane allows two motions: of the pairs that were used, the one that was.
        rotation[used & np.isnan(found.last.contradiction_rad)] = (
            found.last.view_graph.cam2_from_cam1.rotation
        )
        pairs = [
            _Pairs.of(view_graph, model, conflicts, _disagrees(view_graph, rotation, model))
            for model, conflicts in zip(models, found.conflicts)
            if (conflicts.contradicts_model if num_rounds == 0 else _is_doubtful(conflicts))
        ]
        if not pairs:
            break
        dropped = used & np.any([p.is_misleading for p in pairs], axis=0)
        if splits := num_rounds >= MAX_ROUNDS or not dropped.any():
            dropped = used & (np.any([p.is_between for p in pairs], axis=0) | _are_apart(view_graph, models))
        if not dropped.any():
            break
        attempt = map_pairs(used & ~dropped)
        if not attempt.mapped.models:  # a model in doubt, with a warning, is better than none
            break
        used &= ~dropped
        is_split |= splits
        for p in pairs:
            is_known = dropped & np.isfinite(p.fraction)
            fraction[is_known] = p.fraction[is_known]
        unused = _unused(view_graph, attempt, used, fraction)
        found = Separation(attempt, _conflicts_of(attempt.mapped), unused, is_split)
    return found


def _is_doubtful(conflicts: ConflictingPoints) -> bool:
    """Whether a model of a later round, after an earlier one was in doubt, still shows different things as one."""
    count = int(conflicts.is_contradiction.sum())
    return count >= MIN_PAIRS_AGAIN and count > MAX_CONTRADICTING_AGAIN * int(conflicts.is_judged.sum())


def map_once(view_graph: ViewGraph, map_pairs: Callable[[Bool[np.ndarray, " n"]], Attempt]) -> Separation:
    """Map the images with all pairs, even if points of a model conflict."""
    used = np.ones(len(view_graph), bool)
    attempt = map_pairs(used)
    unused = _unused(view_graph, attempt, used, np.full(len(view_graph), np.nan))
    return Separation(attempt, _conflicts_of(attempt.mapped), unused)


def _are_apart(view_graph: ViewGraph, models: Sequence[Reconstruction]) -> np.ndarray:
    """Pairs whose images are in different models."""
    of_image = np.full(len(models[0].images), -1)
    for number, model in enumerate(models):
        of_image[model.is_registered()] = number
    first, second = of_image[view_graph.image1], of_image[view_graph.image2]
    return np.asarray((first != second) & (first >= 0) & (second >= 0))


def _unused(
    view_graph: ViewGraph, attempt: Attempt, used: np.ndarray, fraction: np.ndarray
) -> ContradictingPairs:
    is_unused = ~used | np.isfinite(attempt.contradiction_rad)
    return ContradictingPairs(
        view_graph.select(is_unused),
        attempt.contradiction_rad[is_unused],
        ~used[is_unused],
        fraction[is_unused],
    )


def _conflicts_of(mapped: Mapped) -> tuple[ConflictingPoints, ...]:
    """Conflicting points of each model."""
    return tuple(find_conflicting_points(model) for model in mapped.models)


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """The pairs of the view graph in a model that shows different things as one."""

    is_misleading: np.ndarray
    """Pairs of different things that agree with the model."""
    is_between: np.ndarray
    """Pairs of different clusters, and of clusters of few images."""
    fraction: np.ndarray
    """Fraction of conflicts; NaN if the pair was not judged."""

    @classmethod
    def of(
        cls, view_graph: ViewGraph, model: Reconstruction, found: ConflictingPoints, disagrees: np.ndarray
    ) -> _Pairs:
        num_images, judged = len(model.images), np.flatnonzero(found.is_judged)
        image1, image2, evidence = found.image1[judged], found.image2[judged], found.evidence[judged]
        cluster = cluster_images(num_images, image1, image2, evidence).astype(np.int64)
        registered = model.is_registered()
        is_in_model = registered[view_graph.image1] & registered[view_graph.image2]
        own = _values(view_graph.image1, view_graph.image2, image1, image2, evidence)
        ends = cluster[view_graph.image1], cluster[view_graph.image2]
        safe = ~_is_ambiguous(num_images, image1, image2, evidence)
        core = cluster_images(num_images, image1[safe], image2[safe], evidence[safe]).astype(np.int64)
        of_clusters = _values(*ends, cluster[image1], cluster[image2], evidence)
        speaks_against = np.where(np.isfinite(own), own < 0.0, of_clusters < 0.0)
        is_small = np.bincount(core)[core] < LEAST_IMAGES
        apart = core[view_graph.image1] != core[view_graph.image2]
        apart |= is_small[view_graph.image1] | is_small[view_graph.image2]
        return cls(
            is_in_model & speaks_against & ~disagrees,
            is_in_model & apart,
            _values(view_graph.image1, view_graph.image2, image1, image2, found.fraction[judged]),
        )


def _is_ambiguous(
    num_images: int, image1: np.ndarray, image2: np.ndarray, evidence: np.ndarray
) -> np.ndarray:
    """Pairs that seem to show the same thing, where a third image seems to show the same as one of them, and clearly not as the other.

    Then one of the two similar pairs is wrong, and which one is unknown. Weaker pairs of their images are no more certain.
    """
    shape = (num_images, num_images)
    joins = csr_matrix(((evidence > 0.0).astype(np.float64), (image1, image2)), shape=shape)
    parts = csr_matrix(((evidence < -CLEAR_EVIDENCE).astype(np.float64), (image1, image2)), shape=shape)
    joins, parts = joins + joins.T, parts + parts.T
    num_thirds = joins @ parts + parts @ joins
    ambiguous = (evidence > 0.0) & (np.asarray(num_thirds[image1, image2]).ravel() > 0.0)
    strongest = np.zeros(num_images)
    for image in (image1, image2):
        np.maximum.at(strongest, image[ambiguous], evidence[ambiguous])
    weaker = (evidence > 0.0) & (evidence < np.maximum(strongest[image1], strongest[image2]))
    return np.asarray(ambiguous | weaker)


def _values(
    ask1: np.ndarray, ask2: np.ndarray, row1: np.ndarray, row2: np.ndarray, value: np.ndarray
) -> np.ndarray:
    """For each pair (ask1, ask2), the sum of the values of the rows with these numbers in any order; NaN if there are none."""
    size = 1 + max(int(x.max(initial=0)) for x in (ask1, ask2, row1, row2))
    asked = np.minimum(ask1, ask2).astype(np.int64) * size + np.maximum(ask1, ask2)
    key, row = np.unique(
        np.minimum(row1, row2).astype(np.int64) * size + np.maximum(row1, row2), return_inverse=True
    )
    if len(key) == 0:
        return np.full(len(asked), np.nan)
    at = np.minimum(np.searchsorted(key, asked), len(key) - 1)
    return np.where(key[at] == asked, np.bincount(row, value)[at], np.nan)


def _disagrees(view_graph: ViewGraph, rotation: np.ndarray, model: Reconstruction) -> np.ndarray:
    """Pairs with a known rotation image2_from_image1 (n, 3, 3) that is not the one in the model."""
    in_model = model.cams_from_world().rotation
    expected = in_model[view_graph.image2] @ np.swapaxes(in_model[view_graph.image1], 1, 2)
    off = np.swapaxes(expected, 1, 2) @ rotation
    known = np.isfinite(off).all(axis=(1, 2))
    angle = np.zeros(len(off))
    angle[known] = Rotation3(off[known]).angle_rad()
    return angle > DISAGREES_RAD
