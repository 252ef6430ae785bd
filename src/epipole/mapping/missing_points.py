"""Points that are missing in images that should see them: a sign that a model shows different things as one.

Two images of different things that look alike share the points that look alike. If a model shows the things as one,
each of the images should also see what surrounds the other's thing, and does not. Images of the same thing share points
everywhere in their overlap, except where something hides them (missing correspondences: Zach, Irschara, Bischof, CVPR 2008).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32

from epipole._checks import Declared, checked
from epipole.scene import Reconstruction

GRID = 6
"""Cells per side of an image: presence is compared cell by cell, because what hides or differs is connected."""
MIN_PRESENT_IN_CELL = 3.0
"""Points that a cell should show ; none at all then has a probability of 5 % (Poisson)."""
MIN_EXPECTED_IN_CELL, MIN_EXPECTED = 6, 20
MAX_PRESENT = 0.05
"""Largest fraction of present points of a cell that is absent."""
MIN_VIEW_COSINE, MAX_DISTANCE_RATIO = np.cos(np.deg2rad(25.0)), 1.6
"""Views of a point that are more alike than this show features that match."""
MIN_SHARED = 15
MARGIN_PX = 5.0
MAX_IMAGES = 60
"""Images that are checked, evenly spread."""
MAX_ABSENT = 0.3
"""Fraction of an overlap beyond which it is not the same things that both images see, unless something hides them."""
MAX_CONTRADICTING, MIN_PAIRS = 0.1, 20
"""A model is in doubt if more of its pairs, and at least 20, lack more of their overlap. In ten right models of
photographs at most 4.4 % did (and 5 of 28 pairs of tourists' photographs); in three cities of equal blocks that were mapped
onto each other, 13 to 29 %. A room that is tiled all over, with nothing else to see, does not show it (3 to 4 %)."""


@dataclass(frozen=True, slots=True, eq=False)
class MissingPoints(Declared):
    """Pairs of registered images that share points, and how much of their overlap shows no common point."""

    image1: Int32[np.ndarray, " n"]
    """Image that observes the points."""
    image2: Int32[np.ndarray, " n"]
    """Image in which they are expected."""
    absent_fraction: Float64[np.ndarray, " n"]
    """Fraction of the expected points that lie in cells where hardly any is observed."""

    def __len__(self) -> int:
        return len(self.image1)

    @property
    def is_contradiction(self) -> Bool[np.ndarray, " n"]:
        """Pairs that lack a large part of their overlap."""
        return self.absent_fraction > MAX_ABSENT

    @property
    def contradicts_model(self) -> bool:
        """Whether more pairs do than hidden surfaces explain: the model probably shows different things as one."""
        count = int(self.is_contradiction.sum())
        return count >= MIN_PAIRS and count > MAX_CONTRADICTING * len(self)

    def __repr__(self) -> str:
        median = np.median(self.absent_fraction) if len(self) else 0.0
        return f"MissingPoints({len(self)} pairs, median {median:.2f})"


@checked
def find_missing_points(model: Reconstruction) -> MissingPoints:
    """Compare the points of each image with those of the images that share points with it.

    Only points from a similar direction and distance are expected, inside the image. The work is the number of observations
    times that of the images checked.
    """
    observed = _observations_of(model)
    registered = np.flatnonzero(model.is_registered())
    checked_images = registered[
        np.linspace(0, len(registered) - 1, min(len(registered), MAX_IMAGES)).astype(int)
    ]
    parts = [_missing_in(model, observed, int(image)) for image in checked_images]
    pairs = np.concatenate([np.zeros((0, 3)), *parts])
    return MissingPoints(pairs[:, 0].astype(np.int32), pairs[:, 1].astype(np.int32), pairs[:, 2].copy())


def _observations_of(model: Reconstruction) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Image, point, direction from camera to point, and distance of each observation, once per image and point."""
    seen = np.unique(np.stack([model.tracks.image, model.tracks.point_of_observation()]), axis=1)
    ray = model.points.xyz_in_world[seen[1]] - model.camera_centers_in_world()[seen[0]]
    distance = np.linalg.norm(ray, axis=1)
    return seen[0], seen[1], ray / np.maximum(distance, 1e-300)[:, None], distance


def _missing_in(model: Reconstruction, observed: tuple[np.ndarray, ...], image: int) -> np.ndarray:
    """(k, 3) other image, this image, absent fraction."""
    of_image, point, direction, distance = observed
    xyz, num_images = model.points.xyz_in_world, len(model.images)
    is_present = np.zeros(len(xyz), bool)
    is_present[point[of_image == image]] = True
    shared = np.bincount(of_image[is_present[point]], minlength=num_images)
    shared[image] = 0
    camera = model.cameras[int(model.camera_of_image[image])]
    inside = model.cams_from_world()[image].apply(xyz)
    pixels = camera.project(inside)
    size = np.array([camera.width, camera.height], np.float64)
    in_view = (inside[:, 2] > 0) & ((pixels > MARGIN_PX) & (pixels < size - 1 - MARGIN_PX)).all(axis=1)
    ray = xyz - model.camera_centers_in_world()[image]
    away = np.maximum(np.linalg.norm(ray, axis=1), 1e-300)
    rows = np.flatnonzero((shared[of_image] >= MIN_SHARED) & in_view[point])
    cosine = np.einsum("ka,ka->k", ray[point[rows]] / away[point[rows]][:, None], direction[rows])
    ratio = away[point[rows]] / np.maximum(distance[rows], 1e-300)
    rows = rows[(cosine > MIN_VIEW_COSINE) & (np.abs(np.log(ratio)) < np.log(MAX_DISTANCE_RATIO))]
    at = np.floor((pixels[point[rows]] + 0.5) / size * GRID).astype(np.int64).clip(0, GRID - 1)
    cell = (of_image[rows] * GRID + at[:, 1]) * GRID + at[:, 0]
    expected = np.bincount(cell, minlength=num_images * GRID**2).reshape(num_images, -1)
    present = np.bincount(cell, is_present[point[rows]], num_images * GRID**2).reshape(num_images, -1)
    counts = expected >= MIN_EXPECTED_IN_CELL
    total = (expected * counts).sum(axis=1)
    absent = (expected * (counts & (present <= MAX_PRESENT * expected))).sum(axis=1)
    others = np.flatnonzero(total >= MIN_EXPECTED)
    return np.stack([others, np.full(len(others), image), absent[others] / total[others]], axis=1)
