"""Parts of a model in which all distances have one scale.

Two parts that share one camera only, and no points, can be scaled relative to each other about that camera without changing any
observation. Methods that position all cameras at once do not notice; here parts grow as a mapper's model would, by images that see
points which others have measured.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int64

from epipole._checks import checked
from epipole.errors import ConfigError
from epipole.mapping.sorting import distinct

MIN_POINTS = 6
"""Points of a part, each seen by two of its images, that another image must see to belong to it. One would determine the scale."""


@checked
def largest_rigid_part(
    num_images: int,
    image: Int64[np.ndarray, " k"],
    point: Int64[np.ndarray, " k"],
    min_points: int = MIN_POINTS,
    min_fraction: float = 0.0,
) -> Bool[np.ndarray, " n"]:
    """The images of the largest part whose distances have one scale.

    The work is the number of observations, plus that of images for each part.

    Args:
        num_images: number of images.
        image: image of each observation.
        point: point of each observation, from 0.
        min_points: points of a part that a further image must see.
        min_fraction: least fraction of its points that these must be: wrong matches that fit by chance are few.

    Raises:
        ConfigError: an image does not exist, a point is negative, `min_points` is not positive, or `min_fraction` is not in [0, 1].
    """
    if not 0.0 <= min_fraction <= 1.0:
        raise ConfigError(f"min_fraction must be between 0 and 1, but is {min_fraction}")
    if min_points < 1 or (point < 0).any() or ((image < 0) | (image >= num_images)).any():
        raise ConfigError("min_points must be positive, and images and points must exist")
    num_points = int(point.max(initial=-1)) + 1
    image, point = np.divmod(distinct(image * num_points + point), max(num_points, 1))
    by_image = _Groups(image, num_images)
    by_point = _Groups(point, num_points)
    is_done, best = np.zeros(num_images, bool), np.zeros(num_images, bool)
    num_points_of = np.bincount(image, minlength=num_images)
    least = np.maximum(min_points, min_fraction * num_points_of)
    for start in np.argsort(-num_points_of, kind="stable"):
        if not is_done[start] and num_points_of[start] > 0:
            part = _grown_from(int(start), image, point, by_image, by_point, least)
            is_done |= part
            best = part if part.sum() > best.sum() else best
    return best


class _Groups:
    """Rows of each value of a column."""

    def __init__(self, column: np.ndarray, size: int) -> None:
        self.order = np.argsort(column, kind="stable")
        self.offsets = np.concatenate([[0], np.cumsum(np.bincount(column, minlength=size))])

    def rows(self, values: np.ndarray) -> np.ndarray:
        starts, counts = self.offsets[values], self.offsets[values + 1] - self.offsets[values]
        ends = np.cumsum(counts)
        return self.order[np.arange(counts.sum()) + np.repeat(starts - ends + counts, counts)]


def _grown_from(
    start: int, image: np.ndarray, point: np.ndarray, by_image: _Groups, by_point: _Groups, least: np.ndarray
) -> np.ndarray:
    """The part of an image and of the one that shares most points with it."""
    num_images = len(by_image.offsets) - 1
    part, num_measured = np.zeros(num_images, bool), np.zeros(num_images, np.int64)
    num_views = np.zeros(len(by_point.offsets) - 1, np.int64)
    shared = np.bincount(image[by_point.rows(point[by_image.rows(np.array([start]))])], minlength=num_images)
    shared[start] = 0
    other = int(np.argmax(shared))
    new = np.array([start, other] if shared[other] >= max(least[start], least[other]) else [start])
    while len(new):
        part[new] = True
        seen, counts = np.unique(point[by_image.rows(new)], return_counts=True)
        is_measured = (num_views[seen] < 2) & (num_views[seen] + counts >= 2)
        num_views[seen] += counts
        num_measured += np.bincount(image[by_point.rows(seen[is_measured])], minlength=num_images)
        new = np.flatnonzero(~part & (num_measured >= least))
    return part
