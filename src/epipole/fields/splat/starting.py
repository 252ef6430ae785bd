"""Initial Gaussians: at known points, or at random positions inside the silhouettes or the cameras' frusta."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8
from scipy.spatial import cKDTree

from epipole._checks import check_count, check_seed, checked
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.fields.training_view import TrainingView
from epipole.scene.gaussian_cloud import DC, GaussianCloud

MOST_SIDE = 512
"""Cells along a side of the first grid, at most."""
MOST_POINTS = 1 << 27
"""Points that are sampled, at most."""
HALVINGS = 3
"""Number of times that the coarsest cells are halved when silhouettes are carved."""
PARALLEL = 1e-3
"""Mean squared sine of the angles between optical axes below which they count as parallel."""
FIRST_OPACITY, NEIGHBORS = 0.15, 3
NEAREST, FARTHEST = 2.0, 100.0
"""Range of sampled depths, in distances between neighboring cameras; nearer points are seen by one camera only, and
farther ones hardly move."""
EMPTY_PARTS, POINTS_OF_PART = 32, 6.0
"""Parts along the longer side of an image in which known points are looked for, at most, and points of a part on average:
then a part of a textured surface is rarely empty by chance."""
BEYOND = 1.2
"""Distance of a point in an empty part, relative to the 95th percentile of the distances of the points in the image."""
TRIES = 40
"""Points sampled for each one wanted."""
MOST_VIEWS = 24
"""Views that each point is checked against, at most."""


def _check_views(views: Sequence[TrainingView], least: int = 1) -> None:
    if len(views) < least:
        raise ConfigError(f"{least} or more views are needed, got {len(views)}")


@checked
def cloud_of_points(
    points_in_world: Float64[np.ndarray, "n 3"], rgb: UInt8[np.ndarray, "n 3"]
) -> GaussianCloud:
    """A round Gaussian at each point, sized by the mean distance to its three nearest neighbors (Kerbl et al. 2023).

    Raises:
        ShapeError: there are fewer than four points, or one is not finite.
    """
    n = len(points_in_world)
    if n <= NEIGHBORS or not np.isfinite(points_in_world).all():
        raise ShapeError(f"{NEIGHBORS + 1} or more finite points are needed, got {n}")
    away = cKDTree(points_in_world).query(points_in_world, NEIGHBORS + 1)[0][:, 1:].mean(axis=1)
    away = np.clip(away, np.median(away) * 1e-2 + 1e-12, np.quantile(away, 0.99) + 1e-12)
    return GaussianCloud(
        points_in_world.astype(np.float32),
        np.repeat(np.log(away)[:, None], 3, axis=1).astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        np.full(n, np.log(FIRST_OPACITY / (1 - FIRST_OPACITY)), np.float32),
        ((rgb / 255.0 - 0.5) / DC).astype(np.float32)[:, None],
    )


@checked
def points_in_frusta(
    views: Sequence[TrainingView], count: int, seed: int = 0
) -> tuple[Float64[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Random points in the frustum of each camera, uniform in inverse depth, with the colors of their pixels.

    Args:
        views: cameras, at two or more positions.
        count: number of points wanted; there may be fewer.
        seed: random seed.

    Raises:
        DegenerateGeometryError: all cameras have the same position, or no pixel is left.
        ConfigError: there are fewer than two views, the count is negative or too large, or the seed is negative.
    """
    _check_views(views, 2)
    check_count(count, "count", MOST_POINTS)
    check_seed(seed)
    centers = np.stack([view.cam_from_world.inverse().translation for view in views])
    between = cKDTree(centers).query(centers, 2)[0][:, 1]
    if not between.any():
        raise DegenerateGeometryError(
            "all cameras have the same position, so the distance of the scene is unknown"
        )
    apart, rng = float(np.median(between[between > 0])), np.random.default_rng([24, seed])
    points, colors = [], []
    for view in views:
        used = np.ones(view.image.shape[:2], bool) if view.used_mask is None else view.used_mask
        if view.image.shape[2] == 4:
            used = used & (view.image[..., 3] > 0)
        row, column = np.nonzero(used)
        chosen = rng.permutation(len(row))[: -(-count // len(views))]
        row, column = row[chosen], column[chosen]
        depth = apart / rng.uniform(1.0 / FARTHEST, 1.0 / NEAREST, len(row))
        rays = view.camera.unproject(np.stack([column, row], axis=1).astype(np.float64))
        points.append(view.cam_from_world.inverse().apply(rays / rays[:, 2:] * depth[:, None]))
        colors.append(view.image[row, column, :3])
    if not any(len(part) for part in points):
        raise DegenerateGeometryError("all pixels of all images are transparent or masked")
    return np.concatenate(points)[:count], np.concatenate(colors)[:count]


@checked
def points_in_empty_parts(
    views: Sequence[TrainingView], points_in_world: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, "k 3"], UInt8[np.ndarray, "k 3"]]:
    """A distant point in every part of an image that shows no known point, such as the sky, with the color of its pixel.

    Without them, no Gaussian covers these parts, and those nearby grow into fog. They lie a little beyond the
    image's far points, so that they do not enlarge the scene much.

    Args:
        views: images with cameras.
        points_in_world: known points.
    """
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    for view in views:
        height, width = view.image.shape[:2]
        local = view.cam_from_world.apply(points_in_world)
        pixels = view.camera.project(local)
        inside = ((pixels >= 0) & (pixels < [width, height])).all(axis=1)
        if not inside.any():
            continue
        side = max(max(width, height) / EMPTY_PARTS, (POINTS_OF_PART * width * height / inside.sum()) ** 0.5)
        rows, columns = max(1, round(height / side)), max(1, round(width / side))
        part = (pixels[inside] * [columns / width, rows / height]).astype(int)
        is_empty = np.ones((rows, columns), bool)
        is_empty[part[:, 1], part[:, 0]] = False
        v, u = ((np.argwhere(is_empty) + 0.5) * [height / rows, width / columns]).astype(int).T
        used = np.ones((height, width), bool) if view.used_mask is None else view.used_mask
        if view.image.shape[2] == 4:
            used = used & (view.image[..., 3] > 0)
        v, u = v[used[v, u]], u[used[v, u]]
        rays = view.camera.unproject(np.stack([u, v], axis=1).astype(np.float64))
        far = BEYOND * np.quantile(np.linalg.norm(local[inside], axis=1), 0.95)
        seen = np.isfinite(rays).all(axis=1)
        rays = rays[seen] / np.linalg.norm(rays[seen], axis=1, keepdims=True)
        points.append(view.cam_from_world.inverse().apply(far * rays))
        colors.append(view.image[v[seen], u[seen], :3])
    return np.concatenate(points), np.concatenate(colors)


@checked
def points_in_silhouettes(
    views: Sequence[TrainingView], count: int, seed: int = 0
) -> tuple[Float64[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Random points in the ball that all cameras look at, outside no silhouette, with their mean colors.

    Args:
        views: cameras that look at a common point.
        count: number of points wanted; there may be fewer.
        seed: random seed.

    Raises:
        DegenerateGeometryError: the cameras see nothing in common.
        ConfigError: there is no view, the count is negative or too large, or the seed is negative.
    """
    check_count(count, "count", MOST_POINTS // TRIES)
    check_seed(seed)
    rng = np.random.default_rng([19, seed])
    middle, radius = common_ball(views)
    samples = rng.normal(size=(TRIES * count, 3))
    size = radius * np.cbrt(rng.uniform(size=(len(samples), 1)))
    points = middle + size * samples / np.linalg.norm(samples, axis=1, keepdims=True)
    step = max(1, len(views) // MOST_VIEWS)
    color, seen, kept = np.zeros((len(points), 3)), np.zeros(len(points)), np.ones(len(points), bool)
    for view in views[::step]:
        pixels = view.camera.project(view.cam_from_world.apply(points))
        inside = np.isfinite(pixels).all(axis=1)
        at = np.rint(np.where(inside[:, None], pixels, -1)).astype(int)
        inside &= (at >= 0).all(axis=1) & (at[:, 0] < view.camera.width) & (at[:, 1] < view.camera.height)
        rows, columns = at[inside, 1], at[inside, 0]
        color[inside] += view.image[rows, columns, :3]
        seen[inside] += 1
        if view.image.shape[2] == 4:
            kept[inside] &= view.image[rows, columns, 3] > 0
    kept &= seen > 0
    if not kept.any():
        raise DegenerateGeometryError(
            "the views of these cameras do not overlap: do their axes have the convention of the format?"
        )
    chosen = np.flatnonzero(kept)[:count]
    return points[chosen], np.rint(color[chosen] / seen[chosen, None]).astype(np.uint8)


@checked
def fraction_in_view(views: Sequence[TrainingView], points_in_world: Float64[np.ndarray, "n 3"]) -> float:
    """Fraction of the points that project into an image, ignoring occlusion: the median of all views.

    Raises:
        ConfigError: there is no view.
        ShapeError: there is no point.
    """
    _check_views(views)
    if not len(points_in_world):
        raise ShapeError("points_in_world must not be empty")
    fractions = []
    for view in views:
        pixels = view.camera.project(view.cam_from_world.apply(points_in_world))
        inside = (pixels >= 0) & (pixels <= np.array([view.camera.width, view.camera.height]))
        fractions.append(float(inside.all(axis=1).mean()))
    return float(np.median(fractions))


class Silhouette(NamedTuple):
    """An image with transparency."""

    view: TrainingView
    away: np.ndarray
    """(h, w) distance to the nearest pixel that is not fully transparent, in pixels."""


@checked
def silhouettes_of(views: Sequence[TrainingView]) -> list[Silhouette]:
    """Silhouettes of all images with an alpha channel."""
    found = []
    for view in views:
        if view.image.shape[2] == 4:
            is_empty = (view.image[..., 3] == 0).astype(np.uint8)
            away = cv2.distanceTransform(is_empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            found.append(Silhouette(view, away if not is_empty.all() else np.full_like(away, np.inf)))
    return found


@checked
def may_be_full(
    silhouettes: Sequence[Silhouette], centers_in_world: Float64[np.ndarray, "n 3"], radius: float
) -> Bool[np.ndarray, " n"]:
    """Whether each ball (n, 3) touches the silhouettes of all images that see its center.

    Raises:
        ShapeError: silhouette and view have different sizes.
    """
    kept = np.ones(len(centers_in_world), bool)
    for view, away in silhouettes:
        if away.shape != view.image.shape[:2]:
            raise ShapeError(f"silhouette and view must have the same size, got {away.shape}")
        positions = view.cam_from_world.apply(centers_in_world)
        pixels = view.camera.project(positions)
        inside = np.isfinite(pixels).all(axis=1)
        at = np.rint(np.where(inside[:, None], pixels, -1)).astype(int)
        inside &= (at >= 0).all(axis=1) & (at[:, 0] < view.camera.width) & (at[:, 1] < view.camera.height)
        # A ball around the camera is visible everywhere.
        depth = positions[inside, 2] - radius
        seen_px = view.camera.focal_px * radius / np.where(depth > 0, depth, np.nan) + 1.0
        kept[inside] &= ~(away[at[inside, 1], at[inside, 0]] > seen_px)
    return kept


@checked
def have_one_direction(views: Sequence[TrainingView]) -> bool:
    """Whether the optical axes are too parallel to have a well-defined intersection.

    Raises:
        ConfigError: there is no view.
    """
    _check_views(views)
    axes = np.stack([view.cam_from_world.rotation[2] for view in views])
    return bool(np.linalg.eigvalsh(_across(axes).sum(axis=0))[0] < PARALLEL * len(views))


def _across(axes: np.ndarray) -> np.ndarray:
    """(n, 3, 3) projection onto the plane perpendicular to each axis (n, 3)."""
    return np.asarray(np.eye(3) - axes[:, :, None] * axes[:, None, :])


@checked
def common_ball(views: Sequence[TrainingView]) -> tuple[np.ndarray, float]:
    """Center, which is the point nearest to all optical axes, and radius of the ball that the images cover.

    Raises:
        DegenerateGeometryError: the axes are parallel, or most cameras look away from the center.
        ConfigError: there is no view.
    """
    _check_views(views)
    centers = np.stack([view.cam_from_world.inverse().translation for view in views])
    axes = np.stack([view.cam_from_world.rotation[2] for view in views])
    across = _across(axes)
    total = across.sum(axis=0)
    if have_one_direction(views):
        raise DegenerateGeometryError(
            "all cameras look in the same direction, so the distance of the scene is unknown"
        )
    middle = np.linalg.solve(total, (across @ centers[..., None])[..., 0].sum(axis=0))
    depth = ((middle - centers) * axes).sum(axis=1)
    if np.median(depth) <= 0:
        raise DegenerateGeometryError(
            "the cameras do not look at a common point: do their axes have the convention of the format?"
        )
    reach = [0.5 * max(v.camera.width, v.camera.height) / v.camera.focal_px for v in views]
    return middle, float(np.median(np.maximum(depth, 0.0) * reach))


@checked
def first_cells(views: Sequence[TrainingView], side: int) -> tuple[np.ndarray, float, np.ndarray]:
    """Corner, cell size and occupied cells (x, y, z), at most `side` per axis, of the scene inside all silhouettes.

    Raises:
        DegenerateGeometryError: the silhouettes have no common volume.
        ConfigError: there is no view, or `side` is not from 1 to 512.
    """
    if not 1 <= side <= MOST_SIDE:
        raise ConfigError(f"side must be from 1 to {MOST_SIDE}, got {side}")
    middle, radius = common_ball(views)
    low, size = middle - radius, 2.0 * radius / side
    silhouettes = silhouettes_of(views)
    full = _full(silhouettes, low, size, (side, side, side))
    if not full.any():
        raise DegenerateGeometryError("the silhouettes of the images have no common volume")
    positions = np.argwhere(full)
    first, last = positions.min(axis=0), positions.max(axis=0) + 1
    low, finer = low + size * first, size * (last - first).max() / side
    shape = tuple(int(n) for n in np.ceil((last - first) * size / finer - 1e-9))
    return low, float(finer), _full(silhouettes, low, float(finer), shape)


def _full(
    silhouettes: Sequence[Silhouette], low: np.ndarray, size: float, shape: tuple[int, ...]
) -> np.ndarray:
    """Cells inside all silhouettes, coarse to fine: the children of an empty cell are not tested."""
    factor = 2**HALVINGS
    cells = np.ones([-(-side // factor) for side in shape], bool)
    while True:
        positions = np.argwhere(cells)
        middles = low + factor * size * (positions + 0.5)
        cells[tuple(positions.T)] = may_be_full(silhouettes, middles, 0.87 * factor * size)
        if factor == 1:
            return cells[tuple(slice(side) for side in shape)]
        factor //= 2
        for axis in range(3):
            cells = cells.repeat(2, axis)
