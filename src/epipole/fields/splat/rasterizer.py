"""Rasterizer for Gaussians: project, sort by depth, assign to tiles, and blend front to back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from epipole import _parallel
from epipole._checks import MOST_RENDERED_PIXELS, Declared, check_fields, check_pixels, checked
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

LEAST_TOGETHER = 1024
"""Gaussians processed as one task, at least."""
MOST_PIECES = 64
"""Most tasks that Gaussians are divided into."""
TILES_TOGETHER = 16
"""Tiles processed as one task."""
ROWS_TOGETHER = 64
"""Image rows processed as one task."""


MOST_BLUR_PX = 1e6


@dataclass(frozen=True, slots=True)
class RenderOptions:
    """Options for rendering Gaussians."""

    blur_px: float = 0.3
    """Variance added to each projected Gaussian, in square pixels, so that none is thinner than a pixel."""
    antialiased: bool = False
    """Reduce the opacity to compensate for the blur (2D filter of Yu et al., Mip-Splatting, 2024)."""
    near: float = 0.01
    """Near plane, in world units."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is negative, too large or not finite.
        """
        check_fields(self)
        if not 0 <= self.blur_px <= MOST_BLUR_PX:
            raise ConfigError(f"blur_px must be from 0 to {MOST_BLUR_PX:g}, got {self.blur_px:g}")
        if not 0 < self.near < np.inf:
            raise ConfigError(f"near must be positive and finite, got {self.near:g}")


class Cloud(NamedTuple):
    """Arrays of a cloud, as the kernels read them."""

    means: np.ndarray
    log_scales: np.ndarray
    quats_wxyz: np.ndarray
    logits: np.ndarray
    sh: np.ndarray


class View(NamedTuple):
    """A camera and its pose, as the kernels read them."""

    rotation: np.ndarray
    translation: np.ndarray
    center: np.ndarray
    focal: np.ndarray
    middle: np.ndarray
    reach: np.ndarray
    """Tangents of half the field of view, horizontal and vertical."""
    width: int
    height: int
    near_plane: float
    blur: float
    antialiased: bool


@dataclass(frozen=True, slots=True, eq=False)
class Rendering(Declared):
    """Render of Gaussians without a background."""

    colour: Float32[np.ndarray, "h w 3"]
    """RGB times coverage."""
    depth: Float32[np.ndarray, "h w"]
    """Along the optical axis, times coverage."""
    coverage: Float32[np.ndarray, "h w"]
    """1 minus the transmittance."""
    tiles: Tiles
    """Tiles, for the backward pass."""

    @checked
    def over(self, background: Float32[np.ndarray, " 3"]) -> Float32[np.ndarray, "h w 3"]:
        """The image over a background color."""
        out, height = np.empty_like(self.colour), len(self.coverage)
        _parallel.map_chunks(
            lambda a, b, _: blend_kernels.put_over(self.colour, self.coverage, background, a, b, out),
            height,
            -(-height // ROWS_TOGETHER),
        )
        return out


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
    num_evaluated: int
    """Number of Gaussian-pixel pairs that were evaluated."""


@checked
def view_of(camera: Camera, cam_from_world: Rigid3, options: RenderOptions) -> View:
    """A camera and its pose, as the kernels read them.

    Raises:
        ConfigError: the camera has distortion or too many pixels.
        ShapeError: cam_from_world is not a single pose.
    """
    check_pixels(camera.width, camera.height, MOST_RENDERED_PIXELS)
    if camera.model not in (CameraModel.PINHOLE, CameraModel.SIMPLE_PINHOLE):
        raise ConfigError("Gaussians are rendered with a PINHOLE camera: undistort the images first")
    if cam_from_world.batch_shape() != ():
        raise ShapeError(
            f"cam_from_world must be a single pose, got a batch of {cam_from_world.batch_shape()}"
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
    """Render Gaussians (Kerbl et al. 2023); the result does not depend on the number of threads.

    Args:
        cloud: Gaussians.
        camera: pinhole camera.
        cam_from_world: its pose.
        options: rendering options; None for the defaults.

    Raises:
        ConfigError: the camera has distortion or too many pixels.
        ShapeError: cam_from_world is not a single finite pose.
    """
    if not np.isfinite(cam_from_world.as_matrix()).all():
        raise ShapeError("cam_from_world is not finite")
    if cloud.origin_in_world.any():
        cam_from_world = cam_from_world @ Rigid3(
            np.eye(3), cloud.origin_in_world
        )  # relative to the cloud's origin
    view = view_of(camera, cam_from_world, RenderOptions() if options is None else options)
    tiles = tiles_of(arrays_of(cloud), view)
    return blend(tiles, view)


def pieces_of(count: int) -> int:
    """Number of tasks that `count` Gaussians are divided into."""
    return max(1, min(count // LEAST_TOGETHER, MOST_PIECES))


def arrays_of(cloud: GaussianCloud) -> Cloud:
    """Contiguous arrays of a cloud."""
    parts = (cloud.means_in_world, cloud.log_scales, cloud.quats_wxyz, cloud.opacity_logits, cloud.sh)
    return Cloud(*(np.ascontiguousarray(part) for part in parts))


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
    return Tiles(order, ellipses, pair, pairs, start, start[1:].copy(), across, 0)


def _by_depth(depths: np.ndarray) -> np.ndarray:
    """Rows of visible Gaussians, nearest first (stable)."""
    first, second = (np.empty(len(depths), np.int64) for _ in range(2))
    counts = np.zeros((3, tile_kernels.LAST_DIGIT + 1), np.int64)
    return second[: tile_kernels.sort_by_depth(depths.view(np.uint32), first, second, counts)]


def blend(tiles: Tiles, view: View) -> Rendering:
    """Blend all tiles front to back."""
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
    """Number of evaluated Gaussian-pixel pairs that changed their pixel."""
    height, width = rendering.coverage.shape
    tiles = rendering.tiles
    parts = _parallel.map_chunks(
        lambda a, b, _: blend_kernels.count_useful(tiles, a, b, width, height),
        len(tiles.stop),
        -(-len(tiles.stop) // TILES_TOGETHER),
    )
    return sum(parts)


class Wanted(NamedTuple):
    """A render and the derivatives of a loss w.r.t. it, as the kernels read them."""

    colour: np.ndarray
    depth: np.ndarray
    coverage: np.ndarray
    by_colour: np.ndarray
    by_depth: np.ndarray
    by_coverage: np.ndarray


class CloudGradient(NamedTuple):
    """Derivatives of a loss w.r.t. the arrays of a cloud; zero for invisible Gaussians."""

    means: np.ndarray
    log_scales: np.ndarray
    quats_wxyz: np.ndarray
    logits: np.ndarray
    sh: np.ndarray
    center: np.ndarray
    """(n, 2) w.r.t. the image position, in pixels."""


class GatherWork(NamedTuple):
    """Scratch of a thread for the backward pass of one Gaussian."""

    total: np.ndarray
    basis: np.ndarray
    by_basis: np.ndarray
    one: CloudGradient


def gather_work(num_sh: int) -> GatherWork:
    """Scratch for Gaussians with `num_sh` harmonics."""
    return GatherWork(np.empty(SUMS), np.empty(16), np.empty(16), gradient_like(1, num_sh))


def gradient_like(count: int, num_sh: int) -> CloudGradient:
    """Zero gradient of `count` Gaussians."""
    shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, num_sh, 3), (count, 2))
    return CloudGradient(*(np.zeros(shape, np.float32) for shape in shapes))


def sums_of_pairs(
    rendering: Rendering,
    by_colour: np.ndarray,
    by_depth: np.ndarray | None = None,
    by_coverage: np.ndarray | None = None,
) -> np.ndarray:
    """Contribution of each ellipse-tile pair to the derivatives of its Gaussian, (pairs, SUMS).

    Args:
            rendering: render.
            by_colour: (h, w, 3) derivative of the loss w.r.t. `rendering.colour`.
            by_depth: (h, w) w.r.t. `rendering.depth`; None: zero.
            by_coverage: (h, w) w.r.t. `rendering.coverage`; None: zero.
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
    """(n,) ellipse of each Gaussian, -1 if invisible; iterating in memory order is three times faster."""
    out = np.full(count, -1, np.int64)
    out[tiles.gaussian] = np.arange(len(tiles.gaussian))
    return out


def gradient_of(
    cloud: Cloud, view: View, tiles: Tiles, by_pair: np.ndarray
) -> tuple[CloudGradient, np.ndarray]:
    """Derivatives of a loss w.r.t. the Gaussians and (6,) w.r.t. xi.

    xi = (translation, rotation) in exp(xi) @ cam_from_world.

    Args:
        cloud: Gaussians that were rendered.
        view: camera and pose.
        tiles: tiles of the render.
        by_pair: from `sums_of_pairs`.
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
