"""Named groups of arrays that the bundle adjustment kernels read and write."""

from typing import NamedTuple

import numpy as np

FIXED, ELIMINATED, KEPT = 0, 1, 2
_LINE = 64
"""Bytes per cache line: loading a vector that straddles two lines takes twice as long."""


class Observations(NamedTuple):
    """Observations, sorted by point."""

    offsets: np.ndarray
    """(points + 1,)"""
    image: np.ndarray
    pixels: np.ndarray
    used: np.ndarray
    """False if excluded from the problem (behind the camera at the start, or not finite)."""
    inverse_sigma: np.ndarray
    """(points,), inverse standard deviation of each point's pixels, relative to that of usual ones."""


class Scene(NamedTuple):
    """Current geometry; motions are rows of nine rotation and three translation entries."""

    cam_from_world: np.ndarray
    """(images, 12)"""
    cam_from_rig: np.ndarray
    """(images, 12)"""
    model: np.ndarray
    """(images,)"""
    params: np.ndarray
    """(images, 12)"""
    points: np.ndarray
    """In world coordinates, (points, 3)."""


class Unknowns(NamedTuple):
    """Free parameters of each image, and their nodes."""

    frame_free: np.ndarray
    """(images, 6) of 0 and 1."""
    num_free: np.ndarray
    """(images,), number of free camera parameters."""
    free_params: np.ndarray
    """(images, 12), indices of the free camera parameters."""
    sensor_free: np.ndarray
    """(images, 6) of 0 and 1."""
    has_rig: np.ndarray
    """Whether cam_from_rig is free or differs from the identity."""
    nodes: np.ndarray
    """(images, 3): nodes of the frame, the shared camera and the sensor; -1 for none."""
    role: np.ndarray
    """(points,): FIXED, ELIMINATED or KEPT (in the reduced system)."""


class Entries(NamedTuple):
    """Pairs of a point and a node that observes it, sorted by point and by node."""

    start: np.ndarray
    """(points + 1,)"""
    node: np.ndarray
    slot: np.ndarray
    """(observations, 3): entry of the point for the frame, the camera and the sensor; -1 for none."""
    point: np.ndarray
    by_node: np.ndarray
    """Entries sorted by node."""
    node_start: np.ndarray
    """(nodes + 1,), start of each node's entries in `by_node`."""
    width: np.ndarray
    """(nodes,), columns of each node."""


class Eliminated(NamedTuple):
    """Data kept of the eliminated points."""

    z: np.ndarray
    """(entries, 3, lanes)"""
    factor: np.ndarray
    """(points, 6): L row by row with its diagonal inverted; zeros if the point stays fixed."""
    h: np.ndarray
    """(points, 3)"""


class Scratch(NamedTuple):
    """Working arrays for one observation's Jacobians."""

    by_point_in_cam: np.ndarray
    by_params: np.ndarray
    j: np.ndarray
    """(2, wide)"""
    j_point: np.ndarray
    factor: np.ndarray
    """(6,)"""
    zeros: np.ndarray
    """(wide,)"""


def rows_of_zeros(shape: tuple[int, ...], dtype: type = np.float64) -> np.ndarray:
    """An array of zeros aligned to a cache line, unlike NumPy's own."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    memory = np.zeros(size + _LINE, np.uint8)
    first = -memory.ctypes.data % _LINE
    return memory[first : first + size].view(dtype).reshape(shape)
