"""How well a model agrees with the matches it was built from."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64

from epipole._checks import check_index, checked
from epipole.mapping.match_components import check_matches, num_keypoints_in, rows_of_groups
from epipole.mapping.model_builder import ModelBuilder
from epipole.scene import Reconstruction, ViewGraph


class MatchConsistency:
    """Fraction of each pair's verified matches that both images observe as one point.

    Matches without a point at either keypoint (too narrow an angle) carry no information and are ignored. In a correct
    model the fraction is high for every pair (typically 0.9). A mirrored initial pair, a wrong pose, or two sides of a
    symmetric object folded onto each other leave pairs with a fraction near zero.
    """

    @checked
    def __init__(self, model: ModelBuilder, view_graph: ViewGraph) -> None:
        check_matches(view_graph, np.array([len(k) for k in model.keypoints], np.int64))
        starts = np.concatenate([[0], np.cumsum([len(k) for k in model.keypoints])]).astype(np.int64)
        row_of_keypoint = np.full(
            starts[-1], -1, np.int32
        )  # there are two arrays of all matches: small numbers
        components = model.components
        row_of_keypoint[starts[components.image] + components.keypoint] = np.arange(len(components.image))
        counts = view_graph.num_inliers()
        first1, first2 = starts[view_graph.image1], starts[view_graph.image2]
        self._row1 = row_of_keypoint[np.repeat(first1, counts) + view_graph.keypoint1]
        self._row2 = row_of_keypoint[np.repeat(first2, counts) + view_graph.keypoint2]
        self._view_graph = view_graph
        self._pairs_of_image = [
            _grouped(side, len(model.keypoints)) for side in (view_graph.image1, view_graph.image2)
        ]

    @checked
    def fractions(self, model: ModelBuilder) -> tuple[Float64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
        """Per pair: fraction of its matches that became one point (NaN unless both are registered), and number of matches."""
        point1, point2 = model.row_point[self._row1], model.row_point[self._row2]
        has_point = (point1 >= 0) | (point2 >= 0)
        count = _num_in_pairs(has_point, self._view_graph)
        same = _num_in_pairs((point1 == point2) & (point1 >= 0), self._view_graph)
        both = model.registered[self._view_graph.image1] & model.registered[self._view_graph.image2]
        return np.where(both, same / np.maximum(count, 1), np.nan), count

    def overall(self, model: ModelBuilder) -> float:
        """The fraction over all matches between registered images; 0 for an empty model."""
        fractions, count = self.fractions(model)
        known = np.isfinite(fractions)
        return float((fractions[known] * count[known]).sum() / max(count[known].sum(), 1))

    @checked
    def num_explained(self, model: ModelBuilder) -> int:
        """Number of matches that both images observe as one point."""
        point1, point2 = model.row_point[self._row1], model.row_point[self._row2]
        return int(((point1 == point2) & (point1 >= 0)).sum())

    @checked
    def of_images(self, model: ModelBuilder) -> Float64[np.ndarray, " n"]:
        """The fraction over the matches of each image with registered images; 1 without such matches."""
        fractions, count = self.fractions(model)
        known, total = np.isfinite(fractions), np.zeros((2, len(model.registered)))
        for side in (self._view_graph.image1, self._view_graph.image2):
            total[0] += np.bincount(side[known], (fractions * count)[known], len(total[0]))
            total[1] += np.bincount(side[known], count[known], len(total[1]))
        return np.divide(total[0], total[1], out=np.ones(len(total[0])), where=total[1] > 0)

    @checked
    def of_image(self, model: ModelBuilder, image: int) -> float:
        """The same for one image, in a time that does not grow with the number of images."""
        check_index(image, "image", len(model.registered))
        graph, sums = self._view_graph, np.zeros(2)
        for pairs in (own[image] for own in self._pairs_of_image):
            pairs = pairs[model.registered[graph.image1[pairs]] & model.registered[graph.image2[pairs]]]
            at = rows_of_groups(graph.match_offsets, pairs)
            point1, point2 = model.row_point[self._row1[at]], model.row_point[self._row2[at]]
            sizes = graph.match_offsets[pairs + 1] - graph.match_offsets[pairs]
            number = np.repeat(np.arange(len(pairs)), sizes)
            count = np.bincount(number[(point1 >= 0) | (point2 >= 0)], minlength=len(pairs))
            same = np.bincount(number[(point1 == point2) & (point1 >= 0)], minlength=len(pairs))
            # One after the other, as in `of_images`: both are equal to the last bit.
            of_pairs = same / np.maximum(count, 1) * count
            sums += [np.bincount(np.zeros(len(pairs), int), each, 1)[0] for each in (of_pairs, count)]
        return float(sums[0] / sums[1]) if sums[1] > 0 else 1.0


def _grouped(image: np.ndarray, num_images: int) -> list[np.ndarray]:
    """Pairs of each image, in order."""
    order = np.argsort(image, kind="stable")
    return np.split(order, np.searchsorted(image[order], np.arange(1, num_images)))


def _num_in_pairs(mask: np.ndarray, view_graph: ViewGraph) -> Int64[np.ndarray, " n"]:
    """For each pair, the number of its matches in a mask (m,) of all matches."""
    out = np.zeros(len(view_graph), np.int64)
    pairs = np.flatnonzero(view_graph.num_inliers())
    if len(pairs):
        out[pairs] = np.add.reduceat(mask, view_graph.match_offsets[pairs], dtype=np.int64)
    return out


@checked
def explained_matches(
    model: Reconstruction, view_graph: ViewGraph
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
    """For each pair, the number of its matches that both images observe as one point, and of those with a point at either keypoint.

    Both are 0 unless both images are registered.
    """
    num_images, tracks = len(model.images), model.tracks
    sizes = num_keypoints_in(view_graph, num_images)
    np.maximum.at(sizes, tracks.image, tracks.keypoint + 1)
    pair = np.repeat(np.arange(len(view_graph)), view_graph.num_inliers())
    image1, image2 = view_graph.image1[pair], view_graph.image2[pair]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    point_of_keypoint = np.full(starts[-1], -1, np.int64)
    point_of_keypoint[starts[tracks.image] + tracks.keypoint] = tracks.point_of_observation()
    point1 = point_of_keypoint[starts[image1] + view_graph.keypoint1]
    point2 = point_of_keypoint[starts[image2] + view_graph.keypoint2]
    registered = model.is_registered()
    both = registered[image1] & registered[image2]
    same = _num_in_pairs(both & (point1 == point2) & (point1 >= 0), view_graph)
    return same, _num_in_pairs(both & ((point1 >= 0) | (point2 >= 0)), view_graph)
