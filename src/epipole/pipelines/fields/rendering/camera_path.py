"""A smooth camera path along the training cameras, where a field shows what the images have seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from epipole.geometry import Rigid3
from epipole.pipelines.fields.cameras import RenderView

SMOOTHING = 1.0
"""Standard deviation of the kernel, in median distances between neighboring cameras."""
LONGEST_STEP = 3.0
"""Longer distances between neighbors count as this many median distances."""
SHORTER = 0.9
"""The order of names is kept unless the nearest-neighbor tour is shorter than this fraction of its length."""


def path_along(views: Sequence[RenderView], frames: int) -> list[RenderView]:
    """Views on a smooth path from the first camera to the last.

    Positions and rotations are averages of the cameras', weighted by a Gaussian of their distance along the path
    (kernel regression; Nadaraya 1964), so every view lies between views that were seen. The cameras keep their order,
    unless a nearest-neighbor tour is much shorter, as for photographs taken in any order. All views have the intrinsics
    of the first camera.

    Args:
        views: cameras, sorted by name.
        frames: number of views.
    """
    centers = np.stack([view.cam_from_world.inverse().translation for view in views])
    rotations = np.stack([view.cam_from_world.rotation for view in views])
    order = _order(centers)
    steps = np.linalg.norm(np.diff(centers[order], axis=0), axis=1)
    moving = steps[steps > 0]
    unit = float(np.median(moving)) if len(moving) else 1.0
    at = np.concatenate([[0.0], np.cumsum(np.clip(steps / unit, 0.2, LONGEST_STEP))])
    out = []
    for n, position in enumerate(np.linspace(0.0, at[-1], frames)):
        weight = np.exp(-0.5 * ((at - position) / SMOOTHING) ** 2)
        weight /= weight.sum()
        rotation = _nearest_rotation(np.einsum("n,nij->ij", weight, rotations[order]))
        center = weight @ centers[order]
        out.append(RenderView(f"{n:05d}", views[0].camera, Rigid3(rotation, -rotation @ center)))
    return out


def _nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation nearest to a mean of rotations (chordal mean; Hartley et al. 2013)."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def _order(centers: np.ndarray) -> np.ndarray:
    """Indices of the cameras along the path."""
    by_name = np.arange(len(centers))
    tours = [_tour(centers, start) for start in {0, int(_farthest(centers))}]
    shortest = min(tours, key=lambda tour: _length(centers[tour]))
    return shortest if _length(centers[shortest]) < SHORTER * _length(centers) else by_name


def _farthest(centers: np.ndarray) -> np.intp:
    """The camera farthest from the median position, an end of an open path."""
    return np.argmax(np.linalg.norm(centers - np.median(centers, axis=0), axis=1))


def _tour(centers: np.ndarray, start: int) -> np.ndarray:
    """From `start`, always to the nearest camera that was not visited yet."""
    order, is_free = [start], np.ones(len(centers), bool)
    is_free[start] = False
    while is_free.any():
        distance = np.linalg.norm(centers - centers[order[-1]], axis=1)
        order.append(int(np.argmin(np.where(is_free, distance, np.inf))))
        is_free[order[-1]] = False
    return np.array(order)


def _length(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
