"""A volume of many depth images, with voxels that suit them, and the colors of its surface."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from epipole.cameras import Camera
from epipole.dense.volume import SparseVolume, blocks_of_depth, blocks_of_keys
from epipole.errors import ConfigError, DegenerateGeometryError
from epipole.geometry import Rigid3
from epipole.scene.view_depth import ViewDepth

PIXELS_PER_VOXEL = 2.5
"""Side of a voxel, in pixels at the median depth of all views."""
SIGMAS_PER_VOXEL = 1.5
"""Smallest side of a voxel, in standard deviations of the depth (the median), so that its noise is averaged."""
USUAL_BLOCKS = 100_000
"""Blocks of 512 voxels at which the voxels become larger."""
MOST_PIXEL_VOXELS = 4.0
"""Largest pixel, in voxels, that is integrated: farther surfaces are left out."""
SAME_DEPTH, GRAY = 0.01, 160
"""Relative difference up to which a view shows a vertex, and the color of vertices that none shows."""


class DepthImage(NamedTuple):
    """A depth image of a pinhole camera, read when needed."""

    camera: Camera
    cam_from_world: Rigid3
    read: Callable[[], ViewDepth]


class ColorImage(NamedTuple):
    """An image with its depth."""

    camera: Camera
    cam_from_world: Rigid3
    rgb: np.ndarray
    depth: np.ndarray


def build_volume(
    images: Sequence[DepthImage],
    voxel: float | None = None,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> SparseVolume:
    """Integrate depth images.

    Args:
        images: the depth images.
        voxel: side of a voxel; None: 2.5 pixels at the median depth, more if the depth is noisy or the scene large.
        progress: called with the number of images integrated, and of all.

    Raises:
        DegenerateGeometryError: no pixel has a depth.
        ConfigError: voxel is not positive, or does not suit the scene.
    """
    usual = _usual_voxel(images)
    side = usual if voxel is None else voxel
    keys = _blocks(images, side)
    while voxel is None and len(keys) > USUAL_BLOCKS:
        side *= max(1.05, float(np.sqrt(len(keys) / USUAL_BLOCKS)))
        keys = _blocks(images, side)
    if not len(keys):
        raise ConfigError("no depth is fine enough for these voxels: pass larger ones (--voxel)")
    volume = SparseVolume(blocks_of_keys(keys), side)
    for n, image in enumerate(images):
        progress(n, len(images))
        volume.add(image.camera, image.cam_from_world, _fine_depth(image, side))
    progress(len(images), len(images))
    return volume


def median_pixel(images: Sequence[DepthImage]) -> float:
    """Side of a pixel at the median depth, in units of the model; the median over all images.

    Raises:
        DegenerateGeometryError: no pixel has a depth.
    """
    sides = []
    for image in images:
        depth = image.read().depth
        if (depth > 0).any():
            sides.append(float(np.nanmedian(depth)) / image.camera.focal_px)
    if not sides:
        raise DegenerateGeometryError("no pixel has a depth, so there is no surface")
    return float(np.median(sides))


def _usual_voxel(images: Sequence[DepthImage]) -> float:
    side = PIXELS_PER_VOXEL * median_pixel(images)
    sigmas = [found.sigma[found.depth > 0] for found in (image.read() for image in images)]
    medians = [float(np.median(values)) for values in sigmas if len(values)]
    return max(side, SIGMAS_PER_VOXEL * float(np.median(medians)))


def _fine_depth(image: DepthImage, voxel: float) -> ViewDepth:
    """The depth without pixels that are much larger than the voxels."""
    found, farthest = image.read(), np.float32(MOST_PIXEL_VOXELS * voxel * image.camera.focal_px)
    return replace(found, depth=np.where(found.depth <= farthest, found.depth, np.float32(np.nan)))


def _blocks(images: Sequence[DepthImage], voxel: float) -> np.ndarray:
    """Sorted keys of all blocks near the surface."""
    keys = np.empty(0, np.int64)
    for image in images:
        own = blocks_of_depth(image.camera, image.cam_from_world, _fine_depth(image, voxel), voxel)
        keys = np.union1d(keys, own)
    return keys


def vertex_colors(vertices_in_world: np.ndarray, images: Iterable[ColorImage]) -> np.ndarray:
    """(n, 3) mean color of each vertex in the images whose depth it has; gray without any."""
    total, count = np.zeros((len(vertices_in_world), 3)), np.zeros(len(vertices_in_world))
    for camera, cam_from_world, rgb, depth in images:
        in_cam = cam_from_world.apply(vertices_in_world)
        pixels = camera.project(in_cam)
        inside = (in_cam[:, 2] > 0) & (pixels > -0.5).all(axis=1)
        inside &= (pixels < [camera.width - 0.5, camera.height - 0.5]).all(axis=1)
        rows = np.flatnonzero(inside)
        column, row = np.rint(pixels[rows]).astype(np.int64).T
        near = np.abs(depth[row, column] - in_cam[rows, 2]) <= SAME_DEPTH * in_cam[rows, 2]
        rows = rows[near]
        total[rows] += rgb[row[near], column[near]]
        count[rows] += 1
    mean = total / np.maximum(count, 1)[:, None]
    return np.rint(np.where(count[:, None] > 0, mean, GRAY)).astype(np.uint8)
