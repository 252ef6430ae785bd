"""Pairs that hold a model together although their images show different things, from what surrounds the things that look alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from epipole.geometry import Rotation3
from epipole.mapping import ConflictingPoints, cluster_images, explained_matches, largest_rigid_part
from epipole.scene import Reconstruction, ViewGraph

MIN_PAIRS_AGAIN, MAX_CONTRADICTING_AGAIN = 3, 0.1
"""Number and fraction of the pairs with conflicts in a model of a later round that are enough to doubt it."""
DISAGREES_RAD = np.deg2rad(25.0)
"""Angle between a pair's rotation and that of the model beyond which the pair does not hold the model together."""
CLEAR_EVIDENCE = 10.0
"""Logarithm of the likelihood ratio of a pair that certainly shows different things."""
MIN_MATCHES, MAX_EXPLAINED, OVERRULED_FACTOR = 30, 0.3, 4.0
"""Matches that a pair needs to be judged, fraction of them that are of one point below which the others overruled it, and how many times
their number the others need. In eleven sets of photographs each pair of the models had a fraction of at least 0.47."""
STRAY_FACTOR = 2.0
"""Matches of an image with another model, compared with those with its own, beyond which it belongs to the other."""
MIN_RIGID_FRACTION = 0.08
"""Least fraction of an image's points by which it has the scale of the others. In rendered models with two scales it was 0.03, in models
of twelve sets of photographs at least 0.15."""
LEAST_IMAGES = 4
"""Images of a cluster that is mapped apart; what fewer images show says too little about their poses."""


@dataclass(frozen=True, slots=True, eq=False)
class FalsePairs:
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
    ) -> FalsePairs:
        """The pairs of a model with these conflicts, of which those whose rotation `disagrees` with the model do not hold it together."""
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


def disagrees(view_graph: ViewGraph, rotation: np.ndarray, model: Reconstruction) -> np.ndarray:
    """Pairs with a known rotation image2_from_image1 (n, 3, 3) that is not the one in the model."""
    return _angles(view_graph, rotation, model) > DISAGREES_RAD


def agrees(view_graph: ViewGraph, rotation: np.ndarray, model: Reconstruction) -> np.ndarray:
    """Pairs with a known rotation image2_from_image1 (n, 3, 3) that is the one in the model."""
    return _angles(view_graph, rotation, model) < DISAGREES_RAD


def _angles(view_graph: ViewGraph, rotation: np.ndarray, model: Reconstruction) -> np.ndarray:
    """Angle between the rotation of each pair and that in the model; NaN if one of them is unknown."""
    in_model = model.cams_from_world().rotation
    expected = in_model[view_graph.image2] @ np.swapaxes(in_model[view_graph.image1], 1, 2)
    off = np.swapaxes(expected, 1, 2) @ rotation
    known = np.isfinite(off).all(axis=(1, 2))
    angle = np.full(len(off), np.nan)
    angle[known] = Rotation3(off[known]).angle_rad()
    return angle


def is_connected_by_conflicts(
    view_graph: ViewGraph, model: Reconstruction, conflicts: ConflictingPoints
) -> bool:
    """Whether without the verified pairs that conflict, however few, some images of a model would not be connected with the others."""
    registered = model.is_registered()
    joins = registered[view_graph.image1] & registered[view_graph.image2]
    image1, image2 = (ends[conflicts.is_contradiction] for ends in (conflicts.image1, conflicts.image2))
    conflicting = _values(view_graph.image1, view_graph.image2, image1, image2, np.ones(len(image1)))
    joins &= np.isnan(conflicting)
    shape = (len(registered), len(registered))
    ends = view_graph.image1[joins], view_graph.image2[joins]
    _, part = connected_components(csr_matrix((np.ones(int(joins.sum())), ends), shape=shape), directed=False)
    sizes = np.sort(np.bincount(part[registered]))
    return len(sizes) > 1 and bool(sizes[-2] >= LEAST_IMAGES)


def is_doubtful(conflicts: ConflictingPoints, num_images: int) -> bool:
    """Whether a model of a later round, after an earlier one was in doubt, still shows different things as one."""
    count, judged = int(conflicts.is_contradiction.sum()), conflicts.is_judged
    if count >= MIN_PAIRS_AGAIN and count > MAX_CONTRADICTING_AGAIN * int(judged.sum()):
        return True
    image1, image2, evidence = (x[judged] for x in (conflicts.image1, conflicts.image2, conflicts.evidence))
    cluster = cluster_images(num_images, image1, image2, evidence).astype(np.int64)
    size, ends = np.bincount(cluster), (cluster[image1], cluster[image2])
    between = _values(*ends, *ends, evidence)
    large = np.minimum(size[ends[0]], size[ends[1]]) >= LEAST_IMAGES
    return bool((large & (ends[0] != ends[1]) & (between < -CLEAR_EVIDENCE)).any())


def are_torn(
    view_graph: ViewGraph, models: Sequence[Reconstruction], in_use: np.ndarray, was_false: np.ndarray
) -> np.ndarray:
    """Pairs of images that other pairs speak against.

    In a right model, nearly all matches of a pair are of the same points. A pair whose matches are not was overruled by
    other pairs. If these have few matches, which of the two are wrong is unknown. And if a model has images in the positions in which
    an earlier one had them, where pairs `was_false`, the pairs that hold it together may be as wrong.
    """
    torn = np.zeros(len(view_graph), bool)
    for model in models:
        explained, count = explained_matches(model, view_graph)
        judged = in_use & (count >= MIN_MATCHES)
        against = judged & (explained < MAX_EXPLAINED * count)
        rotation = np.where(was_false[:, None, None], view_graph.cam2_from_cam1.rotation, np.nan)
        is_again = agrees(view_graph, rotation, model)
        if against.any() or is_again.any():
            weight = np.where(against, -OVERRULED_FACTOR * count, explained).astype(np.float64)
            weight[is_again] = -OVERRULED_FACTOR * view_graph.num_inliers()[is_again]
            judged = judged | is_again
            weight, ends = weight[judged], (view_graph.image1[judged], view_graph.image2[judged])
            cluster = cluster_images(len(model.images), *ends, weight)
            is_apart = cluster[view_graph.image1] != cluster[view_graph.image2]
            torn |= (
                is_apart & model.is_registered()[view_graph.image1] & model.is_registered()[view_graph.image2]
            )
    return torn


def are_stray(view_graph: ViewGraph, models: Sequence[Reconstruction], in_use: np.ndarray) -> np.ndarray:
    """Images with many more matches in another model than in their own."""
    num_matches = np.where(in_use, view_graph.num_inliers(), 0)
    num_images, stray = len(models[0].images), np.zeros(len(models[0].images), bool)
    matches = np.zeros((len(models), num_images))
    for row, model in zip(matches, models):
        inside = model.is_registered()
        for one, other in ((view_graph.image1, view_graph.image2), (view_graph.image2, view_graph.image1)):
            row += np.bincount(one, num_matches * inside[other], num_images)
    for row, model in zip(matches, models):
        stray |= model.is_registered() & (matches.max(axis=0) > STRAY_FACTOR * row)
    return stray


def are_loose(view_graph: ViewGraph, models: Sequence[Reconstruction]) -> np.ndarray:
    """Pairs between the part of a model in which all distances have one scale, and the other images.

    Where matches of different things were left out, those that remain between two parts may be few and wrong.
    """
    loose = np.zeros(len(view_graph), bool)
    for model in models:
        image, point = (
            model.tracks.image.astype(np.int64),
            model.tracks.point_of_observation().astype(np.int64),
        )
        part = largest_rigid_part(len(model.images), image, point, min_fraction=MIN_RIGID_FRACTION)
        others = model.is_registered() & ~part
        loose |= part[view_graph.image1] & others[view_graph.image2]
        loose |= others[view_graph.image1] & part[view_graph.image2]
    return loose


def are_hinges(view_graph: ViewGraph, models: Sequence[Reconstruction], in_use: np.ndarray) -> np.ndarray:
    """Pairs of an image that alone holds the parts of its model together, with the images of all parts but one.

    The image stays with the part with most of its matches. If its pose is wrong, so are those of all the other parts.
    """
    num_images, hinges = len(models[0].images), np.zeros(len(view_graph), bool)
    for model in models:
        explained, _ = explained_matches(model, view_graph)
        strength = np.where(in_use & (explained >= MIN_MATCHES), explained, 0)
        joined = csr_matrix((strength, (view_graph.image1, view_graph.image2)), (num_images, num_images))
        joined += joined.T
        registered = np.flatnonzero(model.is_registered())
        whole = connected_components(joined, directed=False)[1]
        for image in registered:
            others = registered[(registered != image) & (whole[registered] == whole[image])]
            count, part = connected_components(joined[others][:, others], directed=False)
            if count > 1:
                matches = np.bincount(part, joined[image, others].toarray()[0], count)
                apart = np.zeros(num_images, bool)
                apart[others[part != np.argmax(matches)]] = True
                hinges |= (view_graph.image1 == image) & apart[view_graph.image2]
                hinges |= (view_graph.image2 == image) & apart[view_graph.image1]
    return hinges


def are_within(view_graph: ViewGraph, models: Sequence[Reconstruction], images: np.ndarray) -> np.ndarray:
    """Pairs of some images with the others of their models."""
    of_image = _models_of(models)
    same = of_image[view_graph.image1] == of_image[view_graph.image2]
    return np.asarray(same & (images[view_graph.image1] | images[view_graph.image2]))


def _models_of(models: Sequence[Reconstruction]) -> np.ndarray:
    """Number of the model of each image; -1 without one."""
    of_image = np.full(len(models[0].images), -1)
    for number, model in enumerate(models):
        of_image[model.is_registered()] = number
    return of_image


def are_apart(view_graph: ViewGraph, models: Sequence[Reconstruction]) -> np.ndarray:
    """Pairs whose images are in different models."""
    of_image = _models_of(models)
    first, second = of_image[view_graph.image1], of_image[view_graph.image2]
    return np.asarray((first != second) & (first >= 0) & (second >= 0))
