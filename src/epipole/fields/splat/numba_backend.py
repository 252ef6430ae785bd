"""Gaussians on the CPU: project, sort by depth, assign to tiles, and blend front to back (Kerbl et al. 2023)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from epipole import _parallel
from epipole.fields.nerf._vector_kernels import LANES
from epipole.fields.splat import _blend_kernels as blend_kernels
from epipole.fields.splat import _gradient_kernels as gradient_kernels
from epipole.fields.splat import _projection_kernels as projection_kernels
from epipole.fields.splat import _tile_kernels as tile_kernels
from epipole.fields.splat._simd_kernels import PLANE, SUMS
from epipole.fields.splat._tile_kernels import TILE
from epipole.fields.splat.rasterizer import Cloud, CloudGradient, Gradient, ImageGradient, Rendering, View

LEAST_TOGETHER = 1024
"""Gaussians processed as one task, at least."""
MOST_PIECES = 64
"""Most tasks that Gaussians are divided into."""
TILES_TOGETHER = 16
"""Tiles processed as one task."""


class Tiles(NamedTuple):
    """Ellipses sorted by depth, and the tiles they touch."""

    gaussian: np.ndarray
    """(m,) Gaussian of each ellipse."""
    ellipses: np.ndarray
    """(m, 16)"""
    pair: np.ndarray
    """(m + 1,) first ellipse-tile pair of each ellipse."""
    pairs_of_tile: np.ndarray
    """(pairs, 2) ellipse and pair, sorted by tile."""
    start: np.ndarray
    """(tiles + 1,) first row in `pairs_of_tile` of each tile."""
    stop: np.ndarray
    """(tiles,) row at which each tile became opaque."""
    num_across: int


def render(cloud: Cloud, view: View, opacity_factors: np.ndarray | None = None) -> Rendering:
    """See `rasterizer.render_view`; the result does not depend on the number of threads."""
    return blend(tiles_of(cloud, view, opacity_factors), view)


def backward(
    cloud: Cloud,
    view: View,
    rendering: Rendering,
    by_image: ImageGradient,
    reused: CloudGradient | None = None,
) -> Gradient:
    """See `rasterizer.backward`; the result does not depend on the number of threads."""
    by_pair = sums_of_pairs(rendering, by_image)
    return gradient_of(cloud, view, rendering.record, by_pair, reused)


def pieces_of(count: int) -> int:
    """Number of tasks that `count` Gaussians are divided into."""
    return max(1, min(count // LEAST_TOGETHER, MOST_PIECES))


def tiles_of(cloud: Cloud, view: View, shown: np.ndarray | None = None) -> Tiles:
    """Project the Gaussians, sort them by depth, and find the tiles that each touches.

    Args:
        cloud: Gaussians.
        view: camera and pose.
        shown: (n,) factors of the opacities; None: 1.
    """
    seen = np.empty((len(cloud.means), projection_kernels.ELLIPSE), np.float32)
    factors = np.ones(len(seen), np.float32) if shown is None else shown
    depths = np.empty(len(seen), np.float32)
    _parallel.map_chunks(
        lambda a, b, _: projection_kernels.project(view, cloud, factors, a, b, seen, depths, np.empty(16)),
        len(seen),
        pieces_of(len(seen)),
    )
    order = _by_depth(depths)
    ellipses = np.empty((len(order), seen.shape[1]), np.float32)
    size, across = np.array([view.width, view.height]), -(-view.width // TILE)
    num_tiles, pieces = across * -(-view.height // TILE), pieces_of(len(ellipses))
    counts = np.zeros((pieces, num_tiles), np.int64)
    own = np.zeros(len(ellipses), np.int64)
    _parallel.map_chunks(
        lambda a, b, piece: tile_kernels.count_tiles(
            seen, order, a, b, size, across, ellipses, counts[piece], own
        ),
        len(ellipses),
        pieces,
    )
    pair = np.concatenate([[0], np.cumsum(own)])
    start = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    position = start[:-1] + np.cumsum(counts, axis=0) - counts
    pairs = np.empty((int(start[-1]), 2), np.int32)
    _parallel.map_chunks(
        lambda a, b, piece: tile_kernels.fill_tiles(
            ellipses, a, b, size, across, position[piece], pair, pairs
        ),
        len(ellipses),
        pieces,
    )
    return Tiles(order, ellipses, pair, pairs, start, start[1:].copy(), across)


def _by_depth(depths: np.ndarray) -> np.ndarray:
    """Rows of visible Gaussians, nearest first (stable)."""
    first, second = (np.empty(len(depths), np.int64) for _ in range(2))
    counts = np.zeros((3, tile_kernels.LAST_DIGIT + 1), np.int64)
    return second[: tile_kernels.sort_by_depth(depths.view(np.uint32), first, second, counts)]


def blend(tiles: Tiles, view: View) -> Rendering:
    """Blend all tiles front to back."""
    shape = view.height, view.width
    color, depth, coverage = (np.empty(size, np.float32) for size in ((*shape, 3), shape, shape))
    evaluated = np.zeros(len(tiles.stop), np.int64)
    _parallel.map_chunks(
        lambda a, b, _: blend_kernels.blend_tiles(
            tiles, a, b, color, depth, coverage, evaluated, np.empty(5 * PLANE, np.float32)
        ),
        len(tiles.stop),
        -(-len(tiles.stop) // TILES_TOGETHER),
    )
    return Rendering(color, depth, coverage, int(evaluated.sum()), tiles)


def useful_pairs(rendering: Rendering) -> int:
    """Number of evaluated Gaussian-pixel pairs that changed their pixel."""
    height, width = rendering.coverage.shape
    tiles = rendering.record
    parts = _parallel.map_chunks(
        lambda a, b, _: blend_kernels.count_useful(tiles, a, b, width, height),
        len(tiles.stop),
        -(-len(tiles.stop) // TILES_TOGETHER),
    )
    return sum(parts)


class Wanted(NamedTuple):
    """A render and the derivatives of a loss w.r.t. it, as the kernels read them."""

    color: np.ndarray
    depth: np.ndarray
    coverage: np.ndarray
    by_color: np.ndarray
    by_depth: np.ndarray
    by_coverage: np.ndarray


class GatherWork(NamedTuple):
    """Scratch of a thread for the backward pass of one Gaussian."""

    total: np.ndarray
    basis: np.ndarray
    by_basis: np.ndarray


def gradient_like(count: int, num_sh: int) -> CloudGradient:
    """Zero gradient of `count` Gaussians."""
    shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, num_sh, 3), (count, 2))
    return CloudGradient(*(np.zeros(shape, np.float32) for shape in shapes))


def sums_of_pairs(rendering: Rendering, by_image: ImageGradient) -> np.ndarray:
    """Contribution of each ellipse-tile pair to the derivatives of its Gaussian, (pairs, SUMS)."""
    none, tiles = np.zeros_like(rendering.coverage), rendering.record
    wanted = Wanted(
        rendering.color,
        rendering.depth,
        rendering.coverage,
        *(none if part is None else np.ascontiguousarray(part) for part in by_image),
    )
    by_pair = np.empty((len(tiles.pairs_of_tile), SUMS), np.float32)

    def backward(start: int, stop: int, _: int) -> None:
        scratch = np.empty(7 * PLANE, np.float32), np.empty(SUMS * LANES, np.float32)
        blend_kernels.blend_tiles_backward(tiles, start, stop, wanted, by_pair, *scratch)

    _parallel.map_chunks(backward, len(tiles.stop), -(-len(tiles.stop) // TILES_TOGETHER))
    return by_pair


def ellipse_of_gaussian(tiles: Tiles, count: int) -> np.ndarray:
    """(n,) ellipse of each Gaussian, -1 if invisible; iterating in memory order is three times faster."""
    out = np.full(count, -1, np.int64)
    out[tiles.gaussian] = np.arange(len(tiles.gaussian))
    return out


def gradient_of(
    cloud: Cloud, view: View, tiles: Tiles, by_pair: np.ndarray, reused: CloudGradient | None = None
) -> Gradient:
    """Derivatives of a loss w.r.t. the Gaussians and the pose.

    Args:
        cloud: Gaussians that were rendered.
        view: camera and pose.
        tiles: tiles of the render.
        by_pair: from `sums_of_pairs`.
        reused: see `rasterizer.backward`.
    """
    n, num_sh = len(cloud.means), cloud.sh.shape[1]
    fits = reused is not None and reused.sh.shape[:2] == (n, num_sh)
    out = reused if reused is not None and fits else gradient_like(n, num_sh)
    ellipse = ellipse_of_gaussian(tiles, n)

    def gather(start: int, stop: int, _: int) -> np.ndarray:
        by_pose = np.zeros(6)
        gradient_kernels.gather(
            view,
            cloud,
            ellipse,
            tiles.pair,
            by_pair,
            start,
            stop,
            out,
            by_pose,
            GatherWork(np.empty(SUMS), np.empty(16), np.empty(16)),
        )
        return by_pose

    by_poses = _parallel.map_chunks(gather, n, pieces_of(n))
    return Gradient(out, ellipse >= 0, np.sum([np.zeros(6), *by_poses], axis=0))
