"""Where the first Gaussians are: at a model's points and those of stereo, in another field, or drawn where the cameras look."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from epipole.fields.config import SplatConfig
from epipole.fields.splat.starting import (
    cloud_of_points,
    look_the_same_way,
    points_in_frusta,
    points_in_silhouettes,
    share_in_view,
)
from epipole.pipelines.fields.dense_points import dense_points
from epipole.pipelines.fields.pictures import FieldPictures
from epipole.pipelines.fields.scene import gaussians_in
from epipole.scene.gaussian_cloud import NUM_SH, GaussianCloud

LEAST_POINTS = 100
"""Of a model: with fewer the first Gaussians are drawn."""
LEAST_IN_VIEW = 0.02
"""Of the points: with fewer in most pictures the cameras look elsewhere."""
FIRST_SHARE = 0.1
"""Of the Gaussians in the end, where they are drawn."""
FILLED_SHARE = 0.6
"""Of the Gaussians in the end, which stereo fills up to."""


class Start(NamedTuple):
    """What the training begins with."""

    cloud: GaussianCloud
    warnings: list[str]


def first_gaussians(
    pictures: FieldPictures, config: SplatConfig, most: int, told: Callable[[int, int], None]
) -> Start:
    """What the training begins with.

    Args:
        pictures: views to train on, and known points.
        config: where to begin.
        most: Gaussians in the end.
        told: called with the progress of stereo, where that is asked for.

    Raises:
        DegenerateGeometryError: there is no point, and the cameras look away from each other's views.
        FileFormatError: what it should begin with cannot be read.
    """
    if config.start_from is not None:
        cloud = gaussians_in(config.start_from, most).relative_to(pictures.origin_in_world)
        return Start(replace(cloud, sh=np.ascontiguousarray(cloud.sh[:, : NUM_SH[config.sh_degree]])), [])
    points, rgb = pictures.points_in_world, pictures.rgb
    good = np.isfinite(points).all(axis=1)
    points, rgb = points[good], rgb[good]
    if len(points) < LEAST_POINTS or config.start == "random":
        points, rgb = _drawn(pictures, max(LEAST_POINTS, int(FIRST_SHARE * most)), config.seed)
        return Start(cloud_of_points(points, rgb), [])
    warnings = []
    if share_in_view(pictures.train, points) < LEAST_IN_VIEW:
        warnings.append(
            "most cameras look away from the points: are their axes those of the format (OpenGL's in a transforms.json,"
            " OpenCV's in a COLMAP model)?"
        )
    missing = int(FILLED_SHARE * most) - len(points)
    if missing > 0 and config.start == "dense":
        more = dense_points(pictures.train, missing, config.seed, told)
        points, rgb = np.concatenate([points, more.points_in_world]), np.concatenate([rgb, more.rgb])
    return Start(cloud_of_points(points, rgb), warnings)


def _drawn(pictures: FieldPictures, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Where no silhouette is empty; of cameras that look the same way, at any depth."""
    draw = points_in_frusta if look_the_same_way(pictures.train) else points_in_silhouettes
    return draw(pictures.train, count, seed)
