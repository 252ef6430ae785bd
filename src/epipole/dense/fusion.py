"""Fusion of the depth of many views to a cloud: consistency between views, free space, normals, colors and standard deviations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from epipole import _parallel
from epipole._checks import Declared, check_fields, checked
from epipole.dense import _fusion_kernels as kernels
from epipole.dense.normals import normals_of
from epipole.dense.view import DenseView, intrinsics_of
from epipole.errors import ConfigError, ShapeError
from epipole.scene.view_depth import ViewDepth

AGREEING_SIGMAS, AGREEING_FRACTION = 3.0, 0.003
"""Two views agree up to this number of standard deviations plus this fraction of the depth."""
ENOUGH_SOURCES = 3
"""Agreeing sources of a view's depth with which no other view must confirm it."""
SHARED = 0.5
"""Part of the variance that views share, as each was matched with the others."""
MOST_SIGMA = 0.02
"""Largest standard deviation of depths that are used, relative to the depth."""
_ROWS = 32


@dataclass(frozen=True, slots=True, eq=False)
class DensePoints(Declared):
    """Points on surfaces."""

    points_in_world: Float64[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"]
    """Unit vectors toward the camera; zero where unknown."""
    rgb: UInt8[np.ndarray, "n 3"]
    sigma: Float32[np.ndarray, " n"]
    """Standard deviation along the viewing direction, in units of the model."""

    def __post_init__(self) -> None:
        """Check the columns.

        Raises:
            ShapeError: a column has the wrong type or shape.
        """
        check_fields(self)

    @staticmethod
    def joined(parts: Sequence[DensePoints]) -> DensePoints:
        """All points of several sets."""
        none = DensePoints(
            np.empty((0, 3)),
            np.empty((0, 3), np.float32),
            np.empty((0, 3), np.uint8),
            np.empty(0, np.float32),
        )
        every = [none, *parts]
        return DensePoints(
            *(
                np.concatenate([getattr(part, name) for part in every])
                for name in ("points_in_world", "normals", "rgb", "sigma")
            )
        )

    def every(self, step: int) -> DensePoints:
        """Every step-th point, as copies: views would keep the memory of all points.

        Raises:
            ConfigError: step is less than 1.
        """
        if step < 1:
            raise ConfigError(f"step must be at least 1, got {step}")
        return DensePoints(
            *(getattr(self, name)[::step].copy() for name in ("points_in_world", "normals", "rgb", "sigma"))
        )

    def __len__(self) -> int:
        return len(self.points_in_world)

    def __repr__(self) -> str:
        return f"DensePoints({len(self):,} points)"


@dataclass(frozen=True, slots=True, eq=False)
class FusedView(Declared):
    """Points that a view contributes, and the pixels whose depth other views confirm."""

    points: DensePoints
    confirmed: Bool[np.ndarray, "h w"]


@checked
def fuse_view(view: DenseView, depth: ViewDepth, others: Iterable[tuple[DenseView, ViewDepth]]) -> FusedView:
    """Points of a view whose depth other views confirm, each from the view with the smallest pixel there.

    A pixel is confirmed if at least one other view agrees with its depth, or three sources did, and no more views see through the point
    than agree. Its depth is the mean of all agreeing views, weighted by variance.

    Args:
        view: the view.
        depth: its depth.
        others: other views with their depth; their names differ, and decide which of two equal pixels contributes the point.

    Raises:
        ShapeError: a depth does not have its view's size.
    """
    _check_size(view, depth)
    depth = _certain(depth)
    height, width = depth.depth.shape
    sums, counts = np.zeros((height, width, 5), np.float32), np.zeros((height, width, 3), np.uint16)
    for other, seen in others:
        _check_size(other, seen)
        _compare(view, depth, other, _certain(seen), sums, counts)
    agreeing, through, better = counts[..., 0], counts[..., 1], counts[..., 2]
    enough = (agreeing >= 1) | (depth.num_agreeing >= ENOUGH_SOURCES)
    confirmed = (depth.depth > 0) & enough & (through <= agreeing)
    return FusedView(_points(view, depth, confirmed & (better == 0), sums, agreeing), confirmed)


def _certain(depth: ViewDepth) -> ViewDepth:
    """The depth without uncertain pixels, which would agree with too much."""
    kept = depth.sigma <= np.float32(MOST_SIGMA) * depth.depth
    return replace(depth, depth=np.where(kept, depth.depth, np.float32(np.nan)))


def _compare(
    view: DenseView,
    depth: ViewDepth,
    other: DenseView,
    seen: ViewDepth,
    sums: np.ndarray,
    counts: np.ndarray,
) -> None:
    """Add what another view says about the depth of a view."""
    motion = other.cam_from_world @ view.cam_from_world.inverse()
    own = depth.depth, depth.sigma, intrinsics_of(view.camera), view.name < other.name
    there = seen.depth, seen.sigma, other.rgb, intrinsics_of(other.camera)
    matrix, limits = (motion.rotation.ravel(), motion.translation), (AGREEING_SIGMAS, AGREEING_FRACTION)
    _by_rows(
        len(depth.depth),
        lambda start, stop, _: kernels.compare_rows(own, there, matrix, limits, start, stop, sums, counts),
    )


def _points(
    view: DenseView, depth: ViewDepth, chosen: np.ndarray, sums: np.ndarray, agreeing: np.ndarray
) -> DensePoints:
    k, (row, column) = intrinsics_of(view.camera), np.nonzero(chosen)
    z, relative = depth.depth[chosen].astype(np.float64), depth.sigma[chosen] / depth.depth[chosen]
    weight = 1.0 / relative.astype(np.float64) ** 2
    total = weight + sums[chosen, 0]
    z = z * (1.0 + sums[chosen, 1] / total)
    count = agreeing[chosen].astype(np.float64) + 1.0
    sigma = z / np.sqrt(total) * np.sqrt(1.0 + SHARED * (count - 1.0))
    rays = np.stack([(column - k[2]) / k[0], (row - k[3]) / k[1], np.ones(len(row))], axis=1)
    rgb = (view.rgb[chosen] + sums[chosen, 2:]) / count[:, None]
    normals = normals_of(view.camera, depth.depth)
    toward = np.nan_to_num(normals[chosen]) @ view.cam_from_world.rotation.astype(np.float32)
    return DensePoints(
        view.cam_from_world.inverse().apply(rays * z[:, None]),
        np.ascontiguousarray(toward, np.float32),
        np.rint(rgb).astype(np.uint8),
        sigma.astype(np.float32),
    )


def _check_size(view: DenseView, depth: ViewDepth) -> None:
    if depth.depth.shape != view.rgb.shape[:2]:
        raise ShapeError(f"{view.name}: depth and image have different sizes")
    if ((depth.depth > 0) & ~(depth.sigma > 0)).any():
        raise ConfigError(
            f"{view.name}: sigma must be positive where the depth is known; give exact depth a small one, such as 1e-4 of it"
        )


def _by_rows(height: int, work: Callable[[int, int, int], None]) -> None:
    _parallel.map_chunks(work, height, -(-height // _ROWS))
