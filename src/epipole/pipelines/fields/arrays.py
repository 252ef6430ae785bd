"""Gaussians from arrays: images, cameras and poses in, a trained cloud out; no files."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Unpack

import numpy as np
from jaxtyping import Float64, UInt8

from epipole._checks import checked
from epipole.cameras import Camera
from epipole.config import options_of
from epipole.errors import ConfigError, ShapeError
from epipole.fields.splat.starting import (
    cloud_of_points,
    have_one_direction,
    points_in_frusta,
    points_in_silhouettes,
)
from epipole.fields.splat.trainer import SplatTrainer
from epipole.fields.training_view import TrainingView
from epipole.geometry import Rigid3
from epipole.image import undistort_image, undistorted_camera
from epipole.pipelines.fields.config import SplatConfig
from epipole.pipelines.fields.options import SplatKeywords
from epipole.runs import Progress, ProgressCallback, ignore_progress
from epipole.scene.gaussian_cloud import GaussianCloud

NUM_RANDOM = 5000
"""Gaussians to start from where no points are given."""


@checked
def train_splats(
    images: Sequence[UInt8[np.ndarray, "_ _ 3"]],
    cameras: Camera | Sequence[Camera],
    cams_from_world: Rigid3,
    points_in_world: Float64[np.ndarray, "n 3"] | None = None,
    config: SplatConfig | None = None,
    progress: ProgressCallback = ignore_progress,
    **options: Unpack[SplatKeywords],
) -> GaussianCloud:
    """Train 3D Gaussians on images in memory (Kerbl et al. 2023).

    Args:
        images: (h, w, 3) RGB, each of its camera's size.
        cameras: one that took all images, or one per image; images with distortion are undistorted first.
        cams_from_world: pose of each image.
        points_in_world: points to start from; None: random ones in what the cameras see.
        config: options of the training; images of any size are taken as they are.
        progress: called with the percentage that is done.
        **options: single options by name, which override `config`: `time="1m"` or `steps=2000`.

    Raises:
        ConfigError: images, cameras and poses are not of one number, or an option is unknown.
        ShapeError: an image is not of its camera's size, or the points do not fit.
        DegenerateGeometryError: there are no points, and the cameras see nothing in common.
    """
    wanted, n = options_of(SplatConfig, config, options, ["config", "progress"]), len(images)
    own = [cameras] * n if isinstance(cameras, Camera) else list(cameras)
    if cams_from_world.batch_shape() != (n,) or len(own) != n or n == 0:
        raise ConfigError(
            f"{n} images need as many poses and cameras, got {cams_from_world.batch_shape()} and {len(own)}"
        )
    views = [_view(k, images[k], own[k], cams_from_world[k]) for k in range(n)]
    start = _start(views, points_in_world, wanted.seed)
    background = np.full(3, float(wanted.background == "white"), np.float32)
    trainer, began, shown = SplatTrainer(views, start, wanted, background), perf_counter(), -1
    limit = wanted.seconds

    def done() -> float:
        if limit is None:
            return trainer.num_steps / (wanted.steps or 1)
        return (perf_counter() - began) / limit

    while (fraction := done()) < 1.0:
        trainer.step(fraction)
        if (percent := int(100 * fraction)) > shown:
            shown = percent
            progress(Progress("train", percent, 100))
    progress(Progress("train", 100, 100))
    return trainer.cloud


def _view(number: int, image: np.ndarray, camera: Camera, cam_from_world: Rigid3) -> TrainingView:
    if image.shape[:2] != (camera.height, camera.width):
        raise ShapeError(
            f"images[{number}] is {image.shape[1]} x {image.shape[0]}, its camera {camera.width} x {camera.height}"
        )
    pinhole = undistorted_camera(camera)
    return TrainingView(f"{number:05d}", undistort_image(image, camera, pinhole), pinhole, cam_from_world)


def _start(views: Sequence[TrainingView], points: np.ndarray | None, seed: int) -> GaussianCloud:
    if points is not None:
        return cloud_of_points(points, _colors(points, views))
    sample = points_in_frusta if have_one_direction(views) else points_in_silhouettes
    return cloud_of_points(*sample(views, NUM_RANDOM, seed))


def _colors(points: np.ndarray, views: Sequence[TrainingView]) -> np.ndarray:
    """Mean color of each point in the views whose image shows it; gray where none does."""
    total, count = np.full((len(points), 3), 1e-3 * 128), np.full((len(points), 1), 1e-3)
    for view in views:
        with np.errstate(invalid="ignore"):
            column, row = np.rint(view.camera.project(view.cam_from_world.apply(points))).T
            seen = (column >= 0) & (row >= 0) & (column < view.camera.width) & (row < view.camera.height)
        total[seen] += view.image[row[seen].astype(int), column[seen].astype(int), :3]
        count[seen] += 1
    return np.rint(total / count).astype(np.uint8)
