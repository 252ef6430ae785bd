"""Neighboring points that exclude each other: a sign that a model shows different things as one.

Two images of different things that look alike share the points that look alike. If a model shows the things as one, its
points mix: side by side, there are points of one thing, which only its own images see, and points of the other,
which only the other images see. Images of one thing see its points at random, depending on what the detector finds, so
that neighboring points have images in common. This is the local test of visibility of Wilson and Snavely (ICCV 2013), which is for tracks
before mapping, applied to the points of a model as by Heinly, Dunn and Frahm (ECCV 2014).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64
from scipy.spatial import cKDTree

from epipole import _parallel
from epipole._checks import Declared, checked
from epipole.mapping._conflict_kernels import NOT_MARKED, NUM_KINDS, Scratch, Views, count_views
from epipole.mapping.sorting import distinct
from epipole.scene import Reconstruction

NUM_NEIGHBORS = 16
MAX_NEIGHBOR_DISTANCE = 0.08
"""Largest distance of neighbors, as a fraction of the distance to the closest camera that sees the point."""
LIMITS = (float(np.cos(np.deg2rad(20.0))), 1.5)
"""Least cosine of the angle between two views of a point, and largest ratio of their distances: beyond it features may not match."""
MIN_VIEWS = 20
"""Views that a pair of images needs to be judged."""
FRACTION_OF_SAME, FRACTION_OF_DIFFERENT = 0.01, 0.15
"""Typical fraction of conflicts of two images of the same thing, and of different things that look alike. In nine right models of
photographs the median was 0 to 0.03 (0.07 in frames of a video, with short tracks); in five models of rendered scenes that show different
things as one, 0 to 0.006 for pairs of the same thing and 0.13 to 0.5 for the others."""
PART_OF_SAME, LARGEST_OF_SAME, TIMES_OF_SAME = 0.1, 0.06, 4.0
"""Part of the judged pairs that show the same thing in any model; the most that their fraction of conflicts may be; and how many times
as large that of different things is at least. In blurred frames of a video that are all matched with each other, the same thing has
conflicts in 5 to 20 % of the views: a right model of 325 frames was in doubt, and was mapped to ten wrong ones. In seven models of
rendered scenes that show different things as one, the tenth of the pairs with the fewest had at most 0.3 %."""
MAX_CONTRADICTING, MIN_PAIRS = 0.18, 10
"""A model is in doubt if more of its judged pairs, and at least 10, have conflicts as images of different things. In the right models at most
10 % had, in the others 24 to 76 %."""
NUM_BLOCKS, MAX_COUNTS = 8, 16_000_000
"""Least number of blocks of images, which are counted in parallel, and the most counts of a block, of 4 bytes each."""


@dataclass(frozen=True, slots=True, eq=False)
class ConflictingPoints(Declared):
    """Pairs of images with similar views of points of a model, and what they see of these points and of their neighbors.

    A view is a point that one of the images sees, from a similar direction and distance as the other.
    """

    image1: Int32[np.ndarray, " n"]
    image2: Int32[np.ndarray, " n"]
    """Greater than image1."""
    num_common: Int64[np.ndarray, " n"]
    """Views of points that both images see."""
    num_missed: Int64[np.ndarray, " n"]
    """Views of points that the other image misses, while it sees neighbors that have images in common with them."""
    num_conflicting: Int64[np.ndarray, " n"]
    """Views of points that the other image misses, while it sees neighbors, none of which has an image in common with them."""

    def __len__(self) -> int:
        return len(self.image1)

    def among(self, image1: Int32[np.ndarray, " m"], image2: Int32[np.ndarray, " m"]) -> ConflictingPoints:
        """Those of some pairs of images, such as the verified ones."""
        size = 1 + max(int(image.max(initial=0)) for image in (self.image1, self.image2, image1, image2))
        wanted = np.minimum(image1, image2).astype(np.int64) * size + np.maximum(image1, image2)
        rows = np.isin(self.image1.astype(np.int64) * size + self.image2, wanted)
        return ConflictingPoints(*(getattr(self, name)[rows] for name in self.__slots__))

    @property
    def is_judged(self) -> Bool[np.ndarray, " n"]:
        """Pairs with enough views."""
        return np.asarray(self.num_conflicting + self._num_other >= MIN_VIEWS)

    @property
    def fraction(self) -> Float64[np.ndarray, " n"]:
        """Conflicting views, compared with the common or the missed ones, whichever are more."""
        return np.asarray(self.num_conflicting / np.maximum(self.num_conflicting + self._num_other, 1))

    @property
    def typical_fractions(self) -> tuple[float, float]:
        """Fraction of conflicts of two images of the same thing in this model, and of different things."""
        judged = self.fraction[self.is_judged]
        tenth = float(np.quantile(judged, PART_OF_SAME)) if len(judged) else 0.0
        same = min(max(FRACTION_OF_SAME, tenth), LARGEST_OF_SAME)
        return same, max(FRACTION_OF_DIFFERENT, TIMES_OF_SAME * same)

    @property
    def evidence(self) -> Float64[np.ndarray, " n"]:
        """Logarithm of the likelihood ratio of the counts: positive for images of the same thing, negative for different things."""
        same, different = self.typical_fractions
        of_others = self._num_other * np.log((1.0 - same) / (1.0 - different))
        return np.asarray(of_others + self.num_conflicting * np.log(same / different))

    @property
    def is_contradiction(self) -> Bool[np.ndarray, " n"]:
        """Judged pairs that conflict more than images of one thing do."""
        return self.is_judged & (self.fraction > self.typical_fractions[1])

    @property
    def contradicts_model(self) -> bool:
        """Whether the model probably shows different things that look alike as one."""
        count = int(self.is_contradiction.sum())
        return count >= MIN_PAIRS and count > MAX_CONTRADICTING * int(self.is_judged.sum())

    @property
    def _num_other(self) -> np.ndarray:
        return np.maximum(self.num_common, self.num_missed)

    def __repr__(self) -> str:
        median = np.median(self.fraction) if len(self) else 0.0
        return f"ConflictingPoints({len(self)} pairs, median {median:.2f})"


@checked
def find_conflicting_points(
    model: Reconstruction, matched: Int32[np.ndarray, "m 2"] | None = None
) -> ConflictingPoints:
    """Compare each point of a model with its nearest neighbors.

    The work is the number of points times the neighbors and the square of the images of a point.

    Args:
        model: the model.
        matched: pairs of images that were matched; None for all. Two images that were not compared need not have points in common,
            whatever they show, and are left out.
    """
    num_images, xyz = len(model.images), model.points.xyz_in_world
    views, centers, neighbors = _views_of(model), model.camera_centers_in_world(), _neighbors_of(model)
    size = max(1, min(-(-num_images // NUM_BLOCKS), MAX_COUNTS // max(NUM_KINDS * num_images, 1)))

    def count_in(number: int) -> tuple[np.ndarray, ...]:
        block = number * size, min((number + 1) * size, num_images)
        counts = np.zeros((block[1] - block[0], num_images, NUM_KINDS), np.int32)
        scratch = Scratch(np.full(num_images, NOT_MARKED, np.int8), np.zeros(num_images, np.int64))
        count_views(views, xyz, centers, neighbors, block, LIMITS, scratch, counts)
        image, other, kind = np.nonzero(counts)
        count = counts[image, other, kind].astype(np.int64)
        image += block[0]
        return np.minimum(image, other) * num_images + np.maximum(image, other), kind, count

    none = np.zeros(0, np.int64)
    parts = [(none, none, none), *_parallel.map_items(count_in, -(-num_images // size))]
    key, kind, count = (np.concatenate(column) for column in zip(*parts))
    pair, row = np.unique(key, return_inverse=True)
    found = np.zeros((NUM_KINDS, len(pair)), np.int64)
    np.add.at(found, (kind, row), count)
    image1, image2 = np.divmod(pair, max(num_images, 1))
    conflicts = ConflictingPoints(image1.astype(np.int32), image2.astype(np.int32), *found)
    return conflicts if matched is None else conflicts.among(matched[:, 0], matched[:, 1])


def _views_of(model: Reconstruction) -> Views:
    """Each image once per point."""
    num_images, num_points = len(model.images), len(model.points)
    seen = distinct(model.tracks.point_of_observation().astype(np.int64) * num_images + model.tracks.image)
    point, image = np.divmod(seen, max(num_images, 1))
    offsets = np.searchsorted(point, np.arange(num_points + 1))
    ray = model.points.xyz_in_world[point] - model.camera_centers_in_world()[image]
    return Views(offsets.astype(np.int64), image.astype(np.int64), np.ascontiguousarray(ray))


def _neighbors_of(model: Reconstruction) -> np.ndarray:
    """(p, m) nearest points, closest first, then -1."""
    xyz, point = model.points.xyz_in_world, model.tracks.point_of_observation()
    if len(xyz) < 2:
        return np.full((len(xyz), 1), -1)
    closest = np.zeros(len(xyz))
    distances = np.linalg.norm(xyz[point] - model.camera_centers_in_world()[model.tracks.image], axis=1)
    closest[point] = np.inf
    np.minimum.at(closest, point, distances)
    distance, neighbor = cKDTree(xyz).query(xyz, min(NUM_NEIGHBORS + 1, len(xyz)))
    is_near = distance[:, 1:] < MAX_NEIGHBOR_DISTANCE * closest[:, None]
    return np.where(is_near, neighbor[:, 1:], -1).astype(np.int64)
