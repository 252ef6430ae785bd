"""A sample of a model's points that determines its cameras nearly as well as all of them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from epipole._checks import checked
from epipole.mapping import _track_kernels as kernels
from epipole.mapping.model_builder import ModelBuilder

CELLS = 16
"""Cells of an image along each side."""
MIN_NEW = 0.3
"""A point is chosen if this fraction of its observations lie in cells without one."""
LONG_TRACK = 20
"""Points in this number of images come first, without an order among them: the work of an adjustment grows with the square of
the track length."""
LEAST_TRACK = 3
"""A wrong match along the epipolar line makes a point in two images that no residual reveals."""
LEAST_PER_IMAGE = 200
"""Observations that an image should have, if it has as many."""


@checked
def sample_points(model: ModelBuilder) -> Bool[np.ndarray, " p"]:
    """Mask of points whose observations cover the images evenly.

    Points are chosen one by one, those in many images first, if enough of their observations lie in cells of the images that no
    chosen point covers; then those of images with too few observations.
    """
    rows, offsets = model.rows_by_point()
    image, lengths = model.row_image[rows].astype(np.int64), np.diff(offsets)
    sizes = np.stack([model.cameras.width, model.cameras.height], axis=1)[model.camera_of_image]
    cell = np.clip(model.row_pixel[rows] * (CELLS / sizes[image]), 0, CELLS - 1).astype(np.int64)
    order = np.argsort(-np.minimum(lengths, LONG_TRACK), kind="stable")
    order = order[lengths[order] > 0]
    chosen = np.zeros(model.num_points, bool)
    is_covered = np.zeros((len(model.registered), CELLS * CELLS), bool)
    kernels.cover_cells(
        offsets,
        image,
        cell[:, 0] + CELLS * cell[:, 1],
        order[lengths[order] >= LEAST_TRACK],
        MIN_NEW,
        is_covered,
        chosen,
    )
    count = np.bincount(image[chosen[model.row_point[rows]]], minlength=len(model.registered))
    everywhere = np.ones(len(model.registered), bool)
    kernels.cover_images(
        offsets, image, everywhere, order[~chosen[order]], LEAST_PER_IMAGE, count.astype(np.int64), chosen
    )
    return chosen
