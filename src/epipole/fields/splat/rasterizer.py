"""Gaussians to images: projected, sorted by depth, given to tiles, and blended front to back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from epipole import _parallel
from epipole._checks import MOST_RENDERED_PIXELS, check_pixels
from epipole._declared import Declared, check_fields, checked
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, ShapeError
from epipole.fields.nerf._vector_kernels import LANES
from epipole.fields.splat import _blend_kernels as blend_kernels
from epipole.fields.splat import _gradient_kernels as gradient_kernels
from epipole.fields.splat import _projection_kernels as projection_kernels
from epipole.fields.splat import _tile_kernels as tile_kernels
from epipole.fields.splat._simd_kernels import PLANE, SUMS
from epipole.fields.splat._tile_kernels import TILE
from epipole.geometry import Rigid3
from epipole.scene.gaussian_cloud import GaussianCloud

LEAST_TOGETHER, MOST_PIECES, TILES_TOGETHER, ROWS_TOGETHER = 1024, 64, 16, 64
"""Gaussians in one piece of work, unless there would be more pieces than that; tiles, and rows of an image, in one."""


MOST_BLUR_PX = 1e6


@dataclass(frozen=True, slots=True)
class RenderOptions:
    """How Gaussians are drawn."""

    blur_px: float = 0.3
    """Variance, in square pixels, that every ellipse is widened by: none is thinner than a pixel."""
    antialiased: bool = False
    """Take from the opacity what the widening adds (the 2D filter of Yu et al., Mip-Splatting, 2024)."""
    near: float = 0.01
    """Nearer to the camera's plane nothing is drawn, in world units."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: one is negative, too large, or no number.
        """
        check_fields(self)
        if not 0 <= self.blur_px <= MOST_BLUR_PX:
            raise ConfigError(f"blur_px must be from 0 to {MOST_BLUR_PX:g}, got {self.blur_px:g}")
        if not 0 < self.near < np.inf:
            raise ConfigError(f"near must be positive and finite, got {self.near:g}")


class Cloud(NamedTuple):
    """The arrays of a cloud, as kernels read them."""

    means: np.ndarray
    log_scales: np.ndarray
    quats_wxyz: np.ndarray
    logits: np.ndarray
    sh: np.ndarray


class View(NamedTuple):
    """A camera at its place, as kernels read it."""

    rotation: np.ndarray
    translation: np.ndarray
    center: np.ndarray
    focal: np.ndarray
    middle: np.ndarray
    reach: np.ndarray
    """Tangents of half the view, across and down."""
    width: int
    height: int
    near_plane: float
    blur: float
    antialiased: bool


@dataclass(frozen=True, slots=True, eq=False)
class Rendering(Declared):
    """An image of Gaussians, before any background."""

    colour: Float32[np.ndarray, "h w 3"]
    """Times coverage."""
    depth: Float32[np.ndarray, "h w"]
    """Along the optical axis, times coverage."""
    coverage: Float32[np.ndarray, "h w"]
    """1 less what is seen of the background."""
    tiles: Tiles
    """What was drawn where, for the way back."""

    @checked
    def over(self, background: Float32[np.ndarray, " 3"]) -> Float32[np.ndarray, "h w 3"]:
        """The image before a background of one colour."""
        out, height = np.empty_like(self.colour), len(self.coverage)
        _parallel.map_chunks(
            lambda a, b, _: blend_kernels.put_over(self.colour, self.coverage, background, a, b, out),
            height,
            -(-height // ROWS_TOGETHER),
        )
        return out


class Tiles(NamedTuple):
    """Ellipses in the order of their depth, and which tiles they touch."""

    gaussian: np.ndarray
    """(m,) of each ellipse."""
    ellipses: np.ndarray
    """(m, 16)"""
    pair: np.ndarray
    """(m + 1,) the first pair of each ellipse and a tile."""
    pairs_of_tile: np.ndarray
    """(pairs, 2) ellipse and pair, by tiles."""
    start: np.ndarray
    """(tiles + 1,)"""
    stop: np.ndarray
    """(tiles,) where each was over."""
    num_across: int
    num_evaluated: int
    """Pairs of a pixel and a Gaussian that were evaluated."""


@checked
def view_of(camera: Camera, cam_from_world: Rigid3, options: RenderOptions) -> View:
    """A camera at its place.

    Raises:
        ConfigError: the camera has distortion, or more pixels than are rendered.
        ShapeError: the place is not a single motion.
    """
    check_pixels(camera.width, camera.height, MOST_RENDERED_PIXELS)
    if camera.model not in (CameraModel.PINHOLE, CameraModel.SIMPLE_PINHOLE):
        raise ConfigError("Gaussians are drawn by a PINHOLE camera: undistort the images")
    if cam_from_world.batch_shape() != ():
        raise ShapeError(
            f"cam_from_world must be a single motion, got a batch of {cam_from_world.batch_shape()}"
        )
    matrix = camera.K
    focal, middle = np.array([matrix[0, 0], matrix[1, 1]]), matrix[:2, 2].copy()
    return View(
        np.ascontiguousarray(cam_from_world.rotation).reshape(9).astype(np.float64),
        cam_from_world.translation.astype(np.float64),
        cam_from_world.inverse().translation.astype(np.float64),
        focal,
        middle,
        0.5 * np.array([camera.width, camera.height]) / focal,
        camera.width,
        camera.height,
        float(options.near),
        float(options.blur_px),
        bool(options.antialiased),
    )


@checked
def render(
    cloud: GaussianCloud, camera: Camera, cam_from_world: Rigid3, options: RenderOptions | None = None
) -> Rendering:
    """The image of Gaussians (Kerbl et al. 2023), equal for any number of threads.

    Args:
        cloud: the Gaussians.
        camera: a pinhole.
        cam_from_world: where it is.
        options: how they are drawn; None for the defaults.

    Raises:
        ConfigError: the camera has distortion.
        ShapeError: the place is not a single, finite motion.
    """
    if not np.isfinite(cam_from_world.as_matrix()).all():
        raise ShapeError("cam_from_world is not finite")
    if cloud.origin_in_world.any():
        cam_from_world = cam_from_world @ Rigid3(np.eye(3), cloud.origin_in_world)  # of the means' own frame
    view = view_of(camera, cam_from_world, RenderOptions() if options is None else options)
    tiles = tiles_of(arrays_of(cloud), view)
    return blend(tiles, view)


def pieces_of(count: int) -> int:
    """Into how many pieces of work so many Gaussians are cut."""
    return max(1, min(count // LEAST_TOGETHER, MOST_PIECES))


def arrays_of(cloud: GaussianCloud) -> Cloud:
    """Contiguous arrays of a cloud."""
    parts = (cloud.means_in_world, cloud.log_scales, cloud.quats_wxyz, cloud.opacity_logits, cloud.sh)
    return Cloud(*(np.ascontiguousarray(part) for part in parts))


def tiles_of(cloud: Cloud, view: View, shown: np.ndarray | None = None) -> Tiles:
    """Project, sort by depth, and say which ellipses touch which tiles.

    Args:
        cloud: the Gaussians.
        view: how they are seen.
        shown: (n,) factors of their opacities; None: 1.
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
    return Tiles(order, ellipses, pair, pairs, start, start[1:].copy(), across, 0)


def _by_depth(depths: np.ndarray) -> np.ndarray:
    """Rows that are seen, the nearest first, of the same depth in their order."""
    first, second = (np.empty(len(depths), np.int64) for _ in range(2))
    counts = np.zeros((3, tile_kernels.LAST_DIGIT + 1), np.int64)
    return second[: tile_kernels.sort_by_depth(depths.view(np.uint32), first, second, counts)]


def blend(tiles: Tiles, view: View) -> Rendering:
    """Every tile, front to back."""
    shape = view.height, view.width
    colour, depth, coverage = (np.empty(size, np.float32) for size in ((*shape, 3), shape, shape))
    evaluated = np.zeros(len(tiles.stop), np.int64)
    _parallel.map_chunks(
        lambda a, b, _: blend_kernels.blend_tiles(
            tiles, a, b, colour, depth, coverage, evaluated, np.empty(5 * PLANE, np.float32)
        ),
        len(tiles.stop),
        -(-len(tiles.stop) // TILES_TOGETHER),
    )
    return Rendering(colour, depth, coverage, tiles._replace(num_evaluated=int(evaluated.sum())))


def useful_pairs(rendering: Rendering) -> int:
    """How many of the pairs of a pixel and a Gaussian that were evaluated changed their pixel."""
    height, width = rendering.coverage.shape
    tiles = rendering.tiles
    parts = _parallel.map_chunks(
        lambda a, b, _: blend_kernels.count_useful(tiles, a, b, width, height),
        len(tiles.stop),
        -(-len(tiles.stop) // TILES_TOGETHER),
    )
    return sum(parts)


class Wanted(NamedTuple):
    """An image, and derivatives of a loss by it, as kernels read them."""

    colour: np.ndarray
    depth: np.ndarray
    coverage: np.ndarray
    by_colour: np.ndarray
    by_depth: np.ndarray
    by_coverage: np.ndarray


class CloudGradient(NamedTuple):
    """Derivatives of a loss by the arrays of a cloud; zero for Gaussians that are not seen."""

    means: np.ndarray
    log_scales: np.ndarray
    quats_wxyz: np.ndarray
    logits: np.ndarray
    sh: np.ndarray
    center: np.ndarray
    """(n, 2) by where each is seen, in pixels."""


class GatherWork(NamedTuple):
    """What a thread needs to go back to one Gaussian."""

    total: np.ndarray
    basis: np.ndarray
    by_basis: np.ndarray
    one: CloudGradient


def gather_work(num_sh: int) -> GatherWork:
    """For Gaussians of so many harmonics."""
    return GatherWork(np.empty(SUMS), np.empty(16), np.empty(16), gradient_like(1, num_sh))


def gradient_like(count: int, num_sh: int) -> CloudGradient:
    """Zeros."""
    shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, num_sh, 3), (count, 2))
    return CloudGradient(*(np.zeros(shape, np.float32) for shape in shapes))


def sums_of_pairs(
    rendering: Rendering,
    by_colour: np.ndarray,
    by_depth: np.ndarray | None = None,
    by_coverage: np.ndarray | None = None,
) -> np.ndarray:
    """What each pair of an ellipse and a tile adds to its Gaussian's derivatives: (pairs, SUMS).

    Args:
        rendering: the image.
        by_colour: (h, w, 3) dL/d of `rendering.colour`.
        by_depth: (h, w) of its depth; None for none.
        by_coverage: (h, w) of its coverage; None for none.
    """
    none, tiles = np.zeros_like(rendering.coverage), rendering.tiles
    wanted = Wanted(
        rendering.colour,
        rendering.depth,
        rendering.coverage,
        np.ascontiguousarray(by_colour),
        *(none if part is None else np.ascontiguousarray(part) for part in (by_depth, by_coverage)),
    )
    by_pair = np.empty((len(tiles.pairs_of_tile), SUMS), np.float32)

    def backward(start: int, stop: int, _: int) -> None:
        scratch = np.empty(7 * PLANE, np.float32), np.empty(SUMS * LANES, np.float32)
        blend_kernels.blend_tiles_backward(tiles, start, stop, wanted, by_pair, *scratch)

    _parallel.map_chunks(backward, len(tiles.stop), -(-len(tiles.stop) // TILES_TOGETHER))
    return by_pair


def ellipse_of_gaussian(tiles: Tiles, count: int) -> np.ndarray:
    """(n,) row of each Gaussian's ellipse, -1 where it is not seen: what is in the order of memory is read three times faster."""
    out = np.full(count, -1, np.int64)
    out[tiles.gaussian] = np.arange(len(tiles.gaussian))
    return out


def gradient_of(
    cloud: Cloud, view: View, tiles: Tiles, by_pair: np.ndarray
) -> tuple[CloudGradient, np.ndarray]:
    """Derivatives of a loss by Gaussians, and (6,) by xi = (translation, rotation) in exp(xi) @ cam_from_world.

    Args:
        cloud: what was drawn.
        view: how.
        tiles: of the image.
        by_pair: of `sums_of_pairs`.
    """
    n, num_sh = len(cloud.means), cloud.sh.shape[1]
    out, ellipse = gradient_like(n, num_sh), ellipse_of_gaussian(tiles, n)

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
            gather_work(num_sh),
        )
        return by_pose

    by_poses = _parallel.map_chunks(gather, n, pieces_of(n))
    return out, np.sum([np.zeros(6), *by_poses], axis=0)
