"""Global structure-from-motion, without file access: all rotations at once, then all positions, then adjustment.

An incremental model adds up the errors of one image after the other, and stops where the next image sees too few of its
points. Here every pair counts from the beginning (Pan, Barath, Pollefeys, Schoenberger, ECCV 2024). The method needs
pairs with a known motion, and tracks in three images; the incremental mapper needs neither.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from epipole.geometry import Rigid3, Rotation3
from epipole.mapping import (
    AveragedRotations,
    Freedom,
    PairDirections,
    adjust_all,
    average_rotations,
    choose_tracks,
    position_globally,
)
from epipole.optim import BundleConfig, Loss
from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.mappers.incremental import IncrementalMapper, Progress, ignore_progress
from epipole.scene import ViewGraph

TRACKS_PER_IMAGE = 200
"""Observations that each image should have for positioning; the longest tracks are chosen."""
TRACKS_PER_PAIR = 20
"""Matches that each pair should have among them."""
LEAST_IMAGES = 3
MAX_AVERAGINGS = 5
"""Most times that rotations are averaged again without the pairs that contradict them."""
MAX_ANGLE_RAD = np.deg2rad(2.0)
"""Angle between an observation and its positioned point beyond which it takes no part in the first adjustment."""
ERROR_FACTORS = (1.0, 0.3)
"""Largest errors after the first adjustments, as factors of that angle; after them, the mapper's `max_error_px`."""


@dataclass(frozen=True, slots=True, eq=False)
class AveragedCameras:
    """Rotations of the images that pairs with a known motion connect to most others."""

    cams_from_world: Float64[np.ndarray, "n 3 3"]
    is_member: Bool[np.ndarray, " n"]


def map_globally(
    mapper: IncrementalMapper,
    usable: Bool[np.ndarray, " n"],
    progress: Progress = ignore_progress,
    adjusting: Progress = ignore_progress,
) -> bool:
    """Map the usable images; False if their pairs do not determine a model.

    Images that it does not position are registered afterwards, one by one, by their view of the model's points.

    Args:
        mapper: an incremental mapper, which has the model; it adjusts, filters and registers the rest.
        usable: mask of images.
        progress: called with the number of registered and of usable images.
        adjusting: called with the rounds of adjustment.
    """
    model, config, total = mapper.model, mapper.config, int(usable.sum())
    num_rounds = len(ERROR_FACTORS) + config.final_rounds + 2
    progress(0, total)
    model.clear()
    cameras = average_cameras(mapper.view_graph, usable, config)
    if not position_images(mapper, cameras):
        return False
    progress(int(model.registered.sum()), total)
    for done, factor in enumerate((*ERROR_FACTORS, 0.0)):
        adjusting(done, num_rounds)
        _adjust_coarsely(mapper, factor)
        if model.registered.sum() < LEAST_IMAGES:
            return False
    done = len(ERROR_FACTORS) + 1
    model.replace_points(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))
    model.triangulate(np.arange(len(model.components)), config.max_error_px, np.deg2rad(config.min_angle_deg))
    mapper.adjust_globally(config.final_rounds, lambda rounds: adjusting(done + rounds, num_rounds))
    mapper.keep_rigid_part()
    if model.registered.sum() < LEAST_IMAGES:
        return False
    num_positioned = int(model.registered.sum())
    mapper.grow(usable, total, progress)
    if model.registered.sum() > num_positioned:
        mapper.adjust_globally(config.final_rounds)
    mapper.finish()
    doubtful = mapper.consistency.of_images(model) < config.image_fraction
    for image in np.flatnonzero(doubtful & model.registered):
        mapper.take_out_if_wrong(int(image))
    adjusting(num_rounds, num_rounds)
    progress(int(model.registered.sum()), total)
    return True


def average_cameras(
    view_graph: ViewGraph, usable: Bool[np.ndarray, " n"], config: MapperConfig
) -> AveragedCameras:
    """Average the rotations of the usable images, without pairs that contradict the others."""
    limit_rad = np.deg2rad(config.max_contradiction_deg)
    has_motion = np.isfinite(view_graph.cam2_from_cam1.rotation).all(axis=(1, 2))
    used = has_motion & usable[view_graph.image1] & usable[view_graph.image2]
    averaged = _average(view_graph.select(used), len(usable))
    for _ in range(MAX_AVERAGINGS):
        contradicts = averaged.residuals_rad > limit_rad
        if not contradicts.any():
            break
        used[np.flatnonzero(used)[contradicts]] = False
        averaged = _average(view_graph.select(used), len(usable))
    sizes = np.bincount(averaged.component, usable.astype(np.float64))
    return AveragedCameras(averaged.cams_from_world, usable & (averaged.component == np.argmax(sizes)))


def _average(view_graph: ViewGraph, num_images: int) -> AveragedRotations:
    return average_rotations(
        num_images,
        view_graph.image1,
        view_graph.image2,
        np.ascontiguousarray(view_graph.cam2_from_cam1.rotation),
        view_graph.num_inliers().astype(np.float64),
    )


def position_images(mapper: IncrementalMapper, cameras: AveragedCameras) -> bool:
    """Register the images and the points of their longest tracks; False if too few images have such tracks."""
    model, config = mapper.model, mapper.config
    rows = choose_tracks(
        model.components, cameras.is_member, TRACKS_PER_IMAGE, mapper.view_graph, TRACKS_PER_PAIR
    )
    images, row_image = np.unique(model.row_image[rows], return_inverse=True)
    if len(images) < LEAST_IMAGES:
        return False
    _, point, counts = np.unique(model.row_component[rows], return_inverse=True, return_counts=True)
    rotations = cameras.cams_from_world[images]
    directions = np.einsum("kba,kb->ka", rotations[row_image], model.row_ray[rows])
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    pairs = _directions_between(cameras, images, mapper.view_graph, np.deg2rad(config.max_contradiction_deg))
    found = position_globally(
        len(images), offsets, row_image.astype(np.int32), directions, config.seed, pairs
    )
    translations = -np.einsum("nab,nb->na", rotations, found.centers_in_world)
    for k, image in enumerate(images):
        model.register(int(image), Rigid3(rotations[k], translations[k]))
    fits = found.angles_rad < MAX_ANGLE_RAD
    fits &= np.bincount(point[fits], minlength=len(counts))[point] >= 2
    model.replace_points(rows[fits], point[fits], found.points_in_world)
    return bool(fits.any())


def _directions_between(
    cameras: AveragedCameras, images: np.ndarray, view_graph: ViewGraph, limit_rad: float
) -> PairDirections:
    """Directions of the pairs of these images whose rotations agree with the averaged ones; images are numbered by their rows."""
    rotations, num_images = cameras.cams_from_world[images], len(cameras.is_member)
    row = np.full(num_images, -1, np.int32)
    row[images] = np.arange(len(images))
    first, second = row[view_graph.image1], row[view_graph.image2]
    relative = view_graph.cam2_from_cam1
    used = np.flatnonzero(np.isfinite(relative.translation).all(axis=1) & (first >= 0) & (second >= 0))
    first, second, relative = first[used], second[used], relative[used]
    averaged = rotations[second] @ np.swapaxes(rotations[first], 1, 2)
    off_rad = Rotation3(averaged @ np.swapaxes(relative.rotation, 1, 2)).angle_rad()
    agrees = off_rad < limit_rad
    direction = -np.einsum("pba,pb->pa", rotations[second], relative.translation)
    return PairDirections(first[agrees], second[agrees], direction[agrees])


def _adjust_coarsely(mapper: IncrementalMapper, factor: float) -> None:
    """Adjust the positioned model, and drop observations with errors larger than `factor` times the first limit."""
    model, config = mapper.model, mapper.config
    focal_px = float(np.median(model.params[model.camera_of_image[model.registered], 0]))
    limit_px = max(factor * focal_px * np.tan(MAX_ANGLE_RAD), config.max_error_px)
    bundle = BundleConfig(
        loss=Loss.SOFT_L1,
        loss_scale_px=max(limit_px / 4.0, config.loss_scale_px),
        max_iterations=10,
        function_tolerance=1e-5,
    )
    is_first = factor == ERROR_FACTORS[0]
    freedom = Freedom(focal=False, distortion=False) if is_first else mapper.freedom()
    adjust_all(model, bundle, freedom)
    model.filter(limit_px, np.deg2rad(config.min_angle_deg))
    mapper.drop_lost_images()
