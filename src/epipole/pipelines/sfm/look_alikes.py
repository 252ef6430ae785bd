"""Mapping where different things look alike: pairs of images whose points conflict in a model do not hold it together.

A model that shows different things as one agrees with its matches, so that only what surrounds the like parts gives it away. The images
are clustered by their conflicts, and mapped again without the pairs that hold different clusters together as in the model. Other
pairs then decide where the clusters belong. If none do, each cluster becomes a separate model. Once a set is in doubt, there are
further reasons to map it again: pairs that other pairs overrule, images with most of their matches elsewhere, and single images that
hold parts of a model together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32

from epipole.mapping import ConflictingPoints, find_conflicting_points
from epipole.pipelines.sfm.false_pairs import (
    FalsePairs,
    are_apart,
    are_hinges,
    are_loose,
    are_stray,
    are_torn,
    are_within,
    disagrees,
    is_connected_by_conflicts,
    is_doubtful,
)
from epipole.pipelines.sfm.mapping_stage import Mapped
from epipole.pipelines.sfm.matching.pair_selection import ContradictingPairs
from epipole.scene import ViewGraph

MAX_ROUNDS, MAX_SPLITS = 6, 3
"""Times that images are mapped again before they are mapped apart, and times that they are."""


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
    """Of each model, between images of verified pairs. Only these can hold different things together; images that see the same thing need not
    match, as blurred ones."""
    evidence: tuple[ConflictingPoints, ...]
    """Of each model, between all images that were matched."""
    contradicting: ContradictingPairs
    """The verified pairs that the models do not use."""


def map_apart(
    view_graph: ViewGraph,
    map_pairs: Callable[[Bool[np.ndarray, " n"]], Attempt],
    matched: Int32[np.ndarray, "m 2"] | None = None,
) -> Separation:
    """Map the images; while points of a model conflict, map them again without the pairs that hold it together.

    If as large a part of the pairs still conflicts, those pairs were not what was wrong, and the first models are returned.

    Args:
        view_graph: verified pairs.
        map_pairs: maps the images with the pairs of a mask.
        matched: pairs of images that were matched, verified or not; None for all.
    """
    used, fraction = np.ones(len(view_graph), bool), np.full(len(view_graph), np.nan)
    found = first = map_once(view_graph, map_pairs, matched)
    if not any(_are_contradicted(view_graph, found)):
        return found
    was_false = np.zeros(len(view_graph), bool)
    for num_rounds in range(MAX_ROUNDS + MAX_SPLITS):
        models = found.last.mapped.models
        pairs = _doubtful_pairs(view_graph, found, used, is_first=num_rounds == 0)
        dropped = used & _any([p.is_misleading for p in pairs], len(used))
        was_false |= dropped
        if num_rounds > 0:
            in_use = used & np.isnan(found.last.contradiction_rad)
            stray = are_stray(view_graph, models, ~was_false & np.isnan(found.last.contradiction_rad))
            dropped |= used & are_torn(view_graph, models, in_use, was_false)
            dropped |= used & are_within(view_graph, models, stray)
            dropped |= used & are_loose(view_graph, models)
            if not dropped.any():
                dropped |= used & are_hinges(view_graph, models, in_use)
        if not pairs and not dropped.any():
            break
        if num_rounds >= MAX_ROUNDS or not dropped.any():
            is_between = _any([p.is_between for p in pairs], len(used))
            dropped |= used & (is_between | are_apart(view_graph, models))
        if not dropped.any():
            break
        attempt = map_pairs(used & ~dropped)
        if not attempt.mapped.models:  # a model in doubt, with a warning, is better than none
            break
        used &= ~dropped
        for p in pairs:
            is_known = dropped & np.isfinite(p.fraction)
            fraction[is_known] = p.fraction[is_known]
        unused = _unused(view_graph, attempt, used, fraction)
        found = _separation(view_graph, attempt, unused, matched)
    return found if _part_in_conflict(found) < _part_in_conflict(first) else first


def _part_in_conflict(found: Separation) -> float:
    """Part of the judged pairs of all models whose points conflict."""
    judged = sum(int(conflicts.is_judged.sum()) for conflicts in found.conflicts)
    return sum(int(conflicts.is_contradiction.sum()) for conflicts in found.conflicts) / max(judged, 1)


def _any(masks: Sequence[np.ndarray], count: int) -> np.ndarray:
    return np.any([np.zeros(count, bool), *masks], axis=0)


def _doubtful_pairs(
    view_graph: ViewGraph, found: Separation, used: np.ndarray, is_first: bool
) -> list[FalsePairs]:
    """The pairs in each model that shows different things as one."""
    rotation = view_graph.cam2_from_cam1.rotation.copy()
    # A plane allows two motions: of the pairs that were used, the one that was.
    rotation[used & np.isnan(found.last.contradiction_rad)] = found.last.view_graph.cam2_from_cam1.rotation
    models = found.last.mapped.models
    contradicted = (
        _are_contradicted(view_graph, found)
        if is_first
        else [is_doubtful(evidence, len(model.images)) for model, evidence in zip(models, found.evidence)]
    )
    return [
        FalsePairs.of(view_graph, model, evidence, disagrees(view_graph, rotation, model))
        for model, evidence, is_wrong in zip(models, found.evidence, contradicted)
        if is_wrong
    ]


def _are_contradicted(view_graph: ViewGraph, found: Separation) -> list[bool]:
    """Whether each model of the first mapping is in doubt."""
    return [
        conflicts.contradicts_model or is_connected_by_conflicts(view_graph, model, conflicts)
        for model, conflicts in zip(found.last.mapped.models, found.conflicts)
    ]


def map_once(
    view_graph: ViewGraph,
    map_pairs: Callable[[Bool[np.ndarray, " n"]], Attempt],
    matched: Int32[np.ndarray, "m 2"] | None = None,
) -> Separation:
    """Map the images with all pairs, even if points of a model conflict."""
    used = np.ones(len(view_graph), bool)
    attempt = map_pairs(used)
    unused = _unused(view_graph, attempt, used, np.full(len(view_graph), np.nan))
    return _separation(view_graph, attempt, unused, matched)


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


def _separation(
    view_graph: ViewGraph, attempt: Attempt, unused: ContradictingPairs, matched: np.ndarray | None
) -> Separation:
    evidence = tuple(find_conflicting_points(model, matched) for model in attempt.mapped.models)
    verified = view_graph.image1, view_graph.image2
    return Separation(attempt, tuple(found.among(*verified) for found in evidence), evidence, unused)
