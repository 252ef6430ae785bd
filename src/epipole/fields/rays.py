"""Rays of images and cameras, and blocks of cells that rays can skip."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from epipole._checks import MOST_RENDERED_PIXELS, check_pixels, checked
from epipole.cameras import Camera
from epipole.errors import ConfigError, ShapeError
from epipole.fields.nerf._march_kernels import BLOCK
from epipole.fields.training_view import TrainingView
from epipole.geometry import Rigid3

FULL = 255


class Rays(NamedTuple):
    """Images and cameras, as the kernels read them."""

    pixels: np.ndarray
    """(total, 4) uint8, RGBA of all images."""
    offset: np.ndarray
    width: np.ndarray
    intrinsics: np.ndarray
    """(views, 4) fx, fy, cx, cy."""
    rotation: np.ndarray
    center: np.ndarray
    used: np.ndarray
    """(n,) indices of pixels to train on; empty: all."""


@checked
def rays_of(views: Sequence[TrainingView]) -> Rays:
    """Rays of all pixels of all views.

    Raises:
        ConfigError: there is no view, or the masks leave no pixel.
    """
    if not views:
        raise ConfigError("there is no image to train on")
    pixels, offset = [], [0]
    for view in views:
        flat = view.image.reshape(-1, view.image.shape[2])
        if flat.shape[1] == 3:
            flat = np.concatenate([flat, np.full((len(flat), 1), FULL, np.uint8)], axis=1)
        pixels.append(flat)
        offset.append(offset[-1] + len(flat))
    return Rays(
        np.ascontiguousarray(np.concatenate(pixels)),
        np.array(offset, np.int64),
        np.array([view.camera.width for view in views], np.int64),
        *_positions([view.camera for view in views], [view.cam_from_world for view in views]),
        _used(views, offset),
    )


def pixels_to_render(rays: Rays, count: int, rng: np.random.Generator) -> np.ndarray:
    """`count` random pixels among those to train on."""
    if not len(rays.used):
        return rng.integers(0, len(rays.pixels), count)
    return np.asarray(rays.used[rng.integers(0, len(rays.used), count)])


def _used(views: Sequence[TrainingView], offset: list[int]) -> np.ndarray:
    """Indices of pixels that no mask excludes; empty if there are no masks.

    Raises:
        ConfigError: the masks exclude all pixels.
    """
    if all(view.used_mask is None for view in views):
        return np.empty(0, np.int64)
    masks = [np.ones(v.image.shape[:2], bool) if v.used_mask is None else v.used_mask for v in views]
    used = np.concatenate([start + np.flatnonzero(mask) for start, mask in zip(offset, masks)])
    if not len(used):
        raise ConfigError("the masks exclude all pixels of all images")
    return used


@checked
def rays_of_camera(camera: Camera, cam_from_world: Rigid3) -> Rays:
    """Rays of a camera without an image.

    Raises:
        ConfigError: the camera has too many pixels to render.
        ShapeError: the pose is not a single finite pose.
    """
    check_pixels(camera.width, camera.height, MOST_RENDERED_PIXELS)
    if cam_from_world.batch_shape() != ():
        raise ShapeError(f"cam_from_world must be a single pose, got {cam_from_world.batch_shape()}")
    if not np.isfinite(cam_from_world.as_matrix()).all():
        raise ShapeError("cam_from_world is not finite")
    none = np.zeros((0, 4), np.uint8)
    return Rays(
        none,
        np.zeros(2, np.int64),
        np.array([camera.width]),
        *_positions([camera], [cam_from_world]),
        np.empty(0, np.int64),
    )


def _positions(
    cameras: Sequence[Camera], positions: Sequence[Rigid3]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    intrinsics = [[camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]] for camera in cameras]
    rotation = [position.rotation.reshape(9) for position in positions]
    centers = [position.inverse().translation for position in positions]
    return np.array(intrinsics), np.array(rotation), np.array(centers)


def blocks_of(cells: np.ndarray) -> np.ndarray:
    """uint8, whether each block of 8 x 8 x 8 cells (x, y, z) has an occupied cell."""
    padded = np.zeros([-(-side // BLOCK) * BLOCK for side in cells.shape], bool)
    padded[tuple(slice(side) for side in cells.shape)] = cells
    shape = [part for side in padded.shape for part in (side // BLOCK, BLOCK)]
    return np.asarray(padded.reshape(shape).any(axis=(1, 3, 5)), np.uint8)
