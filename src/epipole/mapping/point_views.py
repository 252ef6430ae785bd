"""The directions from which each point of a model is observed, to look for points in a further image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32, Int64

from epipole._checks import Declared, check_indices, checked
from epipole.errors import ShapeError
from epipole.mapping import _view_kernels as kernels

MIN_VIEW_COSINE = float(np.cos(np.deg2rad(40.0)))
"""Cosine of the largest angle between two views of a point: beyond it, SIFT descriptors rarely match (Lowe 2004, 7.3)."""


@dataclass(frozen=True, slots=True, eq=False)
class PointViews(Declared):
    """Observations of a model, sorted by image, with the direction from each point to the camera that observes it."""

    points_in_world: Float64[np.ndarray, "p 3"]
    point: Int32[np.ndarray, " k"]
    """Point of each observation."""
    image: Int32[np.ndarray, " k"]
    keypoint: Int32[np.ndarray, " k"]
    to_camera: Float64[np.ndarray, "k 3"]
    starts: Int64[np.ndarray, " n1"]
    """Image i has the observations from starts[i] to starts[i + 1]."""

    @staticmethod
    @checked
    def of(
        points_in_world: Float64[np.ndarray, "p 3"],
        centers_in_world: Float64[np.ndarray, "n 3"],
        point: Int32[np.ndarray, " k"],
        image: Int32[np.ndarray, " k"],
        keypoint: Int32[np.ndarray, " k"],
    ) -> PointViews:
        """Sort observations by image; those of one image stay in their order.

        Args:
            points_in_world: the points.
            centers_in_world: camera center of each image; unused where an image has no observations.
            point: point of each observation.
            image: image of each observation.
            keypoint: index of the keypoint in its image.

        Raises:
            ShapeError: columns differ in length, or an index is out of range.
        """
        if not len(point) == len(image) == len(keypoint):
            raise ShapeError("point, image and keypoint must have the same length")
        check_indices(point, "point", len(points_in_world))
        check_indices(image, "image", len(centers_in_world))
        order = np.argsort(image, kind="stable")
        point, image, keypoint = point[order], image[order], keypoint[order]
        away = centers_in_world[image] - points_in_world[point]
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-300)
        counts = np.bincount(image, minlength=len(centers_in_world))
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        return PointViews(np.ascontiguousarray(points_in_world), point, image, keypoint, away, starts)

    def __len__(self) -> int:
        return len(self.point)

    @checked
    def rows_of(self, image: int) -> Int64[np.ndarray, " m"]:
        """The observations in an image."""
        return np.arange(self.starts[image], self.starts[image + 1])

    @checked
    def seen_from(
        self,
        center_in_world: Float64[np.ndarray, " 3"],
        neighbors: Int64[np.ndarray, " m"],
        image: int | None = None,
        scratch: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> Int64[np.ndarray, " r"]:
        """For each point that the neighbors observe, the observation from the most similar direction; sorted.

        Points whose directions all differ by more than `MIN_VIEW_COSINE` are left out.

        Args:
            center_in_world: camera center from which the points are looked for.
            neighbors: images whose points are looked for, sorted.
            image: image whose own points are left out; None: none are.
            scratch: arrays (p,) of int64, all -1, and float64, reused between calls; None: allocated.
        """
        observed = kernels.Observations(self.point, self.to_camera, self.starts)
        found = np.empty(len(self.points_in_world), np.int64)
        count = kernels.closest_views(
            observed,
            -1 if image is None else image,
            neighbors,
            center_in_world,
            self.points_in_world,
            MIN_VIEW_COSINE,
            *(self.scratch() if scratch is None else scratch),
            found,
        )
        return np.sort(found[:count])

    def scratch(self) -> tuple[np.ndarray, np.ndarray]:
        """Arrays for repeated calls of `seen_from` by one thread."""
        count = len(self.points_in_world)
        return np.full(count, kernels.NOT_FOUND, np.int64), np.empty(count)
