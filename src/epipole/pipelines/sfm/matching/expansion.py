"""Further pairs from verified ones: distant neighbors without common points, and images that both overlap a third one.

Images that the first pairs connect to many common points need no pair of their own: it would observe the same points once more. Retrieval compares summaries of images, which miss pairs that show the same scene differently. Query expansion (Chum et al., ICCV 2007)
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

from epipole.mapping import connect_matches
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
CONNECTED = 100
"""Tracks in common with which two images need no pair of their own."""
MAX_ROUNDS, LEAST_SUCCESS = 3, 0.2
"""Most rounds of neighbors of neighbors, and the fraction of new pairs that must be verified for another one."""
PAIRS_AT_ONCE = 512
"""Pairs whose tracks are compared at once, which limits the memory."""


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
    later: Int32[np.ndarray, "q 2"],
    per_image: int,
) -> tuple[PairRounds, ViewGraph]:
    """Match and verify later pairs, unless their images have enough tracks in common, and then neighbors of neighbors.

    These are matched round after round, while enough of them are verified.

    Args:
        rounds: the pairs that were matched.
        view_graph: the verified ones.
        folders: folder of matches and folder of geometries of the first round.
        run: executes the units.
        num_features: of each image.
        later: pairs that were chosen, but not matched yet.
        per_image: new pairs of each image in a round of neighbors of neighbors.
    """
    if len(pairs := unconnected(view_graph, later, num_features)):
        rounds, new = _matched(rounds, pairs, folders, run, num_features)
        view_graph = view_graph.joined(new)
    known = np.concatenate([rounds.works[0].pairs, later])
    for _ in range(MAX_ROUNDS):
        pairs = neighbors_of_neighbors(view_graph, known, len(num_features), per_image)
        if len(pairs) == 0:
            break
        known = np.concatenate([known, pairs])
        rounds, new = _matched(rounds, pairs, folders, run, num_features)
        view_graph = view_graph.joined(new)
        if (new.num_inliers() >= STRONG).sum() < LEAST_SUCCESS * len(pairs):
            break
    calibrated = folders[1].with_name(f"{folders[1].name}-calibrated")
    _remove_rounds((*folders, calibrated), len(rounds.works))
    return rounds, view_graph


def _matched(
    rounds: PairRounds,
    pairs: Int32[np.ndarray, "q 2"],
    folders: tuple[Path, Path],
    run: Run,
    num_features: Sequence[int],
) -> tuple[PairRounds, ViewGraph]:
    """Match and verify pairs as another round; returns all rounds, and the verified ones of these pairs."""
    number, work = len(rounds.works), replace(rounds.works[0], pairs=pairs)
    matches = match_units(work, _numbered(folders[0], number))
    run.do(matches, "match")
    units = verification_units(work, _numbered(folders[1], number), matches)
    run.do(units, "verify")
    rounds = PairRounds((*rounds.works, work), (*rounds.matches, tuple(matches)))
    return rounds, load_view_graph(units, num_features)


def unconnected(
    view_graph: ViewGraph, pairs: Int32[np.ndarray, "q 2"], num_features: Sequence[int]
) -> Int32[np.ndarray, "u 2"]:
    """The pairs of images with few tracks of verified matches in common."""
    if len(pairs) == 0:
        return pairs
    tracks = connect_matches(view_graph, np.concatenate([[0], np.cumsum(num_features)]).astype(np.int64))
    track_of_row = np.repeat(np.arange(len(tracks)), np.diff(tracks.offsets))
    shape = len(num_features), len(tracks)
    observed = sparse.csr_array(
        (np.ones(len(track_of_row), np.int32), (tracks.image, track_of_row)), shape=shape
    )
    counts = [
        (observed[some[:, 0]] * observed[some[:, 1]]).sum(axis=1)
        for some in np.split(pairs, range(PAIRS_AT_ONCE, len(pairs), PAIRS_AT_ONCE))
    ]
    return pairs[np.concatenate(counts) < CONNECTED]


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
        for other in range(number, MAX_ROUNDS + 2):
            shutil.rmtree(_numbered(folder, other), ignore_errors=True)
