"""Columns of a growing model: those that kernels read, and a saved state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Rows(NamedTuple):
    """Keypoints that have matches, grouped by component, in kernel layout."""

    image: np.ndarray  # (r,) int32
    pixel: np.ndarray  # (r, 2)
    ray: np.ndarray  # (r, 3) unit, in camera coordinates
    point: np.ndarray  # (r,) int32, -1 = none


class Cams(NamedTuple):
    """Poses and cameras of the images, in kernel layout."""

    motion: np.ndarray  # (n, 12) cam_from_world: R row by row, t
    center: np.ndarray  # (n, 3)
    registered: np.ndarray  # (n,) bool
    camera: np.ndarray  # (n,) int32
    model: np.ndarray  # (c,) int32
    params: np.ndarray  # (c, 12)


class Snapshot(NamedTuple):
    """A saved state of a model."""

    registered: np.ndarray
    motion: np.ndarray
    row_point: np.ndarray
    points: np.ndarray
    params: np.ndarray
