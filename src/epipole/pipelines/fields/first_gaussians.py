"""Initial Gaussians: at the model's points, at stereo points, from another field, or at random."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from epipole.fields.config import SplatTraining
from epipole.fields.splat.starting import (
    cloud_of_points,
    fraction_in_view,
    have_one_direction,
    points_in_empty_parts,
    points_in_frusta,
    points_in_silhouettes,
)
from epipole.pipelines.fields.dense_points import dense_points
from epipole.pipelines.fields.images import FieldImages
from epipole.pipelines.fields.scene import gaussians_in
from epipole.scene.gaussian_cloud import NUM_SH, GaussianCloud

LEAST_POINTS = 100
"""Minimum number of model points; with fewer, Gaussians start at random positions."""
LEAST_IN_VIEW = 0.02
"""Fraction of the points in most images below which the cameras look away from them."""
FIRST_FRACTION = 0.1
"""Initial number of random Gaussians, as a fraction of the maximum."""
DISTANT_FRACTION = 0.1
"""Number of distant Gaussians in parts of images without points, at most, as a fraction of the maximum."""
FILLED_FRACTION = 0.6
"""Number of Gaussians that stereo points fill up to, as a fraction of the maximum."""


class Start(NamedTuple):
    """Initial Gaussians, and warnings."""

    cloud: GaussianCloud
    warnings: list[str]


def first_gaussians(
    images: FieldImages, config: SplatTraining, most: int, progress: Callable[[int, int], None]
) -> Start:
    """Choose the initial Gaussians.

    Args:
        images: views to train on, and known points.
        config: options.
        most: maximum number of Gaussians.
        progress: called with the progress of stereo, if it runs.

    Raises:
        DegenerateGeometryError: there are no points, and the cameras see nothing in common.
        FileFormatError: the field in `start_from` cannot be read.
    """
    if config.start_from is not None:
        cloud = gaussians_in(config.start_from, most).relative_to(images.origin_in_world)
        return Start(replace(cloud, sh=np.ascontiguousarray(cloud.sh[:, : NUM_SH[config.sh_degree]])), [])
    points, rgb = images.points_in_world, images.rgb
    good = np.isfinite(points).all(axis=1)
    points, rgb = points[good], rgb[good]
    if len(points) < LEAST_POINTS or config.start == "random":
        points, rgb = _sampled(images, max(LEAST_POINTS, int(FIRST_FRACTION * most)), config.seed)
        return Start(cloud_of_points(points, rgb), [])
    warnings = []
    if fraction_in_view(images.train, points) < LEAST_IN_VIEW:
        warnings.append(
            "most cameras look away from the points; check the camera axes (OpenGL's in a transforms.json, OpenCV's in a"
            " COLMAP model)"
        )
    missing = int(FILLED_FRACTION * most) - len(points)
    if missing > 0 and config.start == "dense":
        more = dense_points(images.train, missing, config.seed, progress)
        points, rgb = np.concatenate([points, more.points_in_world]), np.concatenate([rgb, more.rgb])
    far, far_rgb = points_in_empty_parts(images.train, points)
    step = max(1, -(-len(far) // max(1, int(DISTANT_FRACTION * most))))
    points, rgb = np.concatenate([points, far[::step]]), np.concatenate([rgb, far_rgb[::step]])
    return Start(cloud_of_points(points, rgb), warnings)


def _sampled(images: FieldImages, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random points inside all silhouettes, or, if all cameras look in one direction, in their frusta."""
    render = points_in_frusta if have_one_direction(images.train) else points_in_silhouettes
    return render(images.train, count, seed)
