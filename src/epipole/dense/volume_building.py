"""A volume of many depth images, with voxels that suit them, and the colors of its surface."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from epipole.cameras import Camera
from epipole.dense.volume import SparseVolume, blocks_of_depth, blocks_of_keys, keys_within
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
    """A depth image of a pinhole camera, read when needed; a pixel of infinite depth shows free space only."""

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
    box: tuple[np.ndarray, np.ndarray] | None = None,
) -> SparseVolume:
    """Integrate depth images.

    Args:
        images: the depth images.
        voxel: side of a voxel; None: 2.5 pixels at the median depth, more if the depth is noisy or the scene large.
        progress: called with the number of images integrated, and of all.
        box: lowest and highest corner of the part that is wanted; the volume is that part, up to whole blocks. None: everything.

    Raises:
        DegenerateGeometryError: no pixel has a depth, or none within the box.
        ConfigError: voxel is not positive, or does not suit the scene.
    """
    side = _usual_voxel(images) if voxel is None else voxel
    keys = _blocks(images, side, box)
    while voxel is None and len(keys) > USUAL_BLOCKS:
        side *= max(1.05, float(np.sqrt(len(keys) / USUAL_BLOCKS)))
        keys = _blocks(images, side, box)
    if not len(keys):
        median_pixel(images)  # raises if no pixel has a depth
        if box is not None:
            raise DegenerateGeometryError(
                "no surface was seen within the box, or only in pixels much larger than the voxels"
            )
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
        known = depth[np.isfinite(depth)]
        if (known > 0).any():
            sides.append(float(np.median(known)) / image.camera.focal_px)
    if not sides:
        raise DegenerateGeometryError("no pixel has a depth, so there is no surface")
    return float(np.median(sides))


def _usual_voxel(images: Sequence[DepthImage]) -> float:
    side = PIXELS_PER_VOXEL * median_pixel(images)
    read = (image.read() for image in images)
    sigmas = [found.sigma[(found.depth > 0) & np.isfinite(found.depth)] for found in read]
    medians = [float(np.median(values)) for values in sigmas if len(values)]
    return max(side, SIGMAS_PER_VOXEL * float(np.median(medians)))


def _fine_depth(image: DepthImage, voxel: float) -> ViewDepth:
    """The depth without pixels that are much larger than the voxels."""
    found, farthest = image.read(), np.float32(MOST_PIXEL_VOXELS * voxel * image.camera.focal_px)
    kept = (found.depth <= farthest) | np.isinf(found.depth)
    return replace(found, depth=np.where(kept, found.depth, np.float32(np.nan)))


def _blocks(
    images: Sequence[DepthImage], voxel: float, box: tuple[np.ndarray, np.ndarray] | None
) -> np.ndarray:
    """Sorted keys of all blocks near the surface that overlap the box."""
    keys = np.empty(0, np.int64)
    for image in images:
        own = blocks_of_depth(image.camera, image.cam_from_world, _fine_depth(image, voxel), voxel)
        keys = np.union1d(keys, own)
    return keys if box is None else keys_within(keys, voxel, *box)


def vertex_colors(
    vertices_in_world: np.ndarray, images: Iterable[ColorImage], voxel: float = 0.0
) -> np.ndarray:
    """(n, 3) mean color of each vertex in the images whose depth it has, up to 1 % or a voxel; gray without any."""
    total, count = np.zeros((len(vertices_in_world), 3)), np.zeros(len(vertices_in_world))
    for camera, cam_from_world, rgb, depth in images:
        in_cam = cam_from_world.apply(vertices_in_world)
        pixels = camera.project(in_cam)
        inside = (in_cam[:, 2] > 0) & (pixels > -0.5).all(axis=1)
        inside &= (pixels < [camera.width - 0.5, camera.height - 0.5]).all(axis=1)
        rows = np.flatnonzero(inside)
        column, row = np.rint(pixels[rows]).astype(np.int64).T
        near = np.abs(depth[row, column] - in_cam[rows, 2]) <= np.maximum(SAME_DEPTH * in_cam[rows, 2], voxel)
        rows = rows[near]
        total[rows] += rgb[row[near], column[near]]
        count[rows] += 1
    mean = total / np.maximum(count, 1)[:, None]
    return np.rint(np.where(count[:, None] > 0, mean, GRAY)).astype(np.uint8)
