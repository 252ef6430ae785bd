"""Further pairs from verified ones: images that both overlap a third probably overlap each other.

Retrieval compares summaries of images, which miss pairs that show the same scene differently. Query expansion (Chum et al., ICCV 2007)
finds some of these pairs from the neighbors of neighbors.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Int32

from epipole.pipelines.sfm.matching.match_stage import (
    PairWork,
    load_view_graph,
    match_units,
    verification_units,
)
from epipole.runs import Run, Unit
from epipole.scene import Cameras, ViewGraph

STRONG = 30
"""Verified matches of a pair that lets its images share their neighbors."""
WELL_CONNECTED = 10
"""Strong pairs with which an image needs no further ones: 30 pairs of each image by retrieval usually have more."""
MAX_ROUNDS, LEAST_SUCCESS = 3, 0.2
"""Most rounds, and the fraction of new pairs that must be verified for another one."""


@dataclass(frozen=True, slots=True, eq=False)
class PairRounds:
    """The pairs to match, in the rounds in which they were found, and the units with their matches."""

    works: tuple[PairWork, ...]
    matches: tuple[tuple[Unit, ...], ...]

    @property
    def all_matches(self) -> list[Unit]:
        """Units of all rounds."""
        return [unit for units in self.matches for unit in units]

    @property
    def work(self) -> PairWork:
        """All pairs."""
        return replace(self.works[0], pairs=np.concatenate([work.pairs for work in self.works]))

    def with_cameras(self, cameras: Cameras, camera_of_image: Int32[np.ndarray, " n"]) -> PairRounds:
        """The same pairs with other cameras."""
        works = (replace(work, cameras=cameras, camera_of_image=camera_of_image) for work in self.works)
        return replace(self, works=tuple(works))

    def verify(self, folder: Path, run: Run, num_features: Sequence[int]) -> ViewGraph:
        """Verify the pairs of all rounds; each round has a folder."""
        units: list[Unit] = []
        for number, (work, matches) in enumerate(zip(self.works, self.matches)):
            of_round = verification_units(work, _numbered(folder, number), matches)
            run.do(of_round, "verify")
            units += of_round
        return load_view_graph(units, num_features)


def expand(
    rounds: PairRounds,
    view_graph: ViewGraph,
    folders: tuple[Path, Path],
    run: Run,
    num_features: Sequence[int],
    per_image: int,
) -> tuple[PairRounds, ViewGraph]:
    """Match and verify neighbors of neighbors, round after round, while enough of them are verified.

    Args:
        rounds: the pairs that were matched.
        view_graph: the verified ones.
        folders: folder of matches and folder of geometries of the first round.
        run: executes the units.
        num_features: of each image.
        per_image: new pairs of each image in a round.
    """
    first = rounds.works[0]
    for number in range(1, MAX_ROUNDS + 1):
        pairs = neighbors_of_neighbors(view_graph, rounds.work.pairs, len(num_features), per_image)
        if len(pairs) == 0:
            break
        work = replace(first, pairs=pairs)
        matches = match_units(work, _numbered(folders[0], number))
        run.do(matches, "match")
        units = verification_units(work, _numbered(folders[1], number), matches)
        run.do(units, "verify")
        new = load_view_graph(units, num_features)
        rounds = PairRounds((*rounds.works, work), (*rounds.matches, tuple(matches)))
        view_graph = view_graph.joined(new)
        if (new.num_inliers() >= STRONG).sum() < LEAST_SUCCESS * len(pairs):
            break
    calibrated = folders[1].with_name(f"{folders[1].name}-calibrated")
    _remove_rounds((*folders, calibrated), len(rounds.works))
    return rounds, view_graph


def neighbors_of_neighbors(
    view_graph: ViewGraph, tried: Int32[np.ndarray, "p 2"], num_images: int, per_image: int
) -> Int32[np.ndarray, "q 2"]:
    """Pairs (i, j), i < j, sorted, that were not tried, of weakly connected images i or j with a common neighbor.

    A candidate counts as much as the weaker pair of the better way to it; each image chooses up to `per_image` new pairs.
    """
    is_strong = view_graph.num_inliers() >= STRONG
    ends = view_graph.image1[is_strong], view_graph.image2[is_strong]
    weight = view_graph.num_inliers()[is_strong]
    i, j = np.concatenate(ends), np.concatenate(ends[::-1])
    shape = (num_images, num_images)
    strength = sparse.csr_array((np.concatenate([weight, weight]), (i, j)), shape=shape)
    was_tried = sparse.csr_array(
        (np.ones(2 * len(tried)), (tried.T.ravel(), tried[:, ::-1].T.ravel())), shape=shape
    )
    found: set[tuple[int, int]] = set()
    for image in range(num_images if per_image else 0):
        row = slice(strength.indptr[image], strength.indptr[image + 1])
        if row.stop - row.start >= WELL_CONNECTED:
            continue
        worth = np.zeros(num_images, np.int64)
        for third, first in zip(strength.indices[row], strength.data[row]):
            beyond = slice(strength.indptr[third], strength.indptr[third + 1])
            others = strength.indices[beyond]
            worth[others] = np.maximum(worth[others], np.minimum(first, strength.data[beyond]))
        worth[image] = 0
        worth[was_tried.indices[was_tried.indptr[image] : was_tried.indptr[image + 1]]] = 0
        best = np.argsort(-worth, kind="stable")[:per_image]
        found |= {(min(image, int(other)), max(image, int(other))) for other in best[worth[best] > 0]}
    return np.array(sorted(found), np.int32).reshape(-1, 2)


def _numbered(folder: Path, number: int) -> Path:
    """The folder of a round; the first has no number."""
    return folder.with_name(f"{folder.name}-round-{number + 1}") if number else folder


def _remove_rounds(folders: Sequence[Path], number: int) -> None:
    """Remove results of further rounds, from other options."""
    for folder in folders:
        for later in range(number, MAX_ROUNDS + 1):
            shutil.rmtree(_numbered(folder, later), ignore_errors=True)
