"""What the inner loops of bundle adjustment read and write: arrays, grouped and named."""

from typing import NamedTuple

import numpy as np

FIXED, ELIMINATED, KEPT = 0, 1, 2
_LINE = 64
"""Bytes in a cache line: loading a vector that straddles two lines takes twice as long."""


class Observations(NamedTuple):
    """What was seen, sorted by point."""

    offsets: np.ndarray
    """(points + 1,)"""
    image: np.ndarray
    pixels: np.ndarray
    used: np.ndarray
    """False: no part of the problem (behind the camera from the start, or not finite)."""


class Scene(NamedTuple):
    """Where everything is; motions are rows of nine rotation and three translation entries."""

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
    """What may move, image by image, and which nodes it belongs to."""

    frame_free: np.ndarray
    """(images, 6) of 0 and 1."""
    num_free: np.ndarray
    """(images,), camera parameters that may change."""
    free_params: np.ndarray
    """(images, 12), which."""
    sensor_free: np.ndarray
    """(images, 6) of 0 and 1."""
    has_rig: np.ndarray
    """Whether cam_from_rig is anything but the identity, or may change."""
    nodes: np.ndarray
    """(images, 3): of the frame, the shared camera and the sensor; -1 for none."""
    role: np.ndarray
    """(points,): HELD, ELIMINATED or KEPT (in the reduced system)."""


class Entries(NamedTuple):
    """Pairs of a point and a node that it meets, by point and by node."""

    start: np.ndarray
    """(points + 1,)"""
    node: np.ndarray
    slot: np.ndarray
    """(observations, 3): which entry of the point is that of the frame, the camera, the sensor; -1 for none."""
    point: np.ndarray
    by_node: np.ndarray
    """Entries sorted by node."""
    node_start: np.ndarray
    """(nodes + 1,), where those of each node start in `by_node`."""
    width: np.ndarray
    """(nodes,), columns of each node."""


class Eliminated(NamedTuple):
    """What is stored of the eliminated points."""

    z: np.ndarray
    """(entries, 3, lanes)"""
    factor: np.ndarray
    """(points, 6): L row by row with its diagonal inverted; zeros where the point stays."""
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
    """An array of zeros aligned to a cache line, which NumPy's own are not."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    memory = np.zeros(size + _LINE, np.uint8)
    first = -memory.ctypes.data % _LINE
    return memory[first : first + size].view(dtype).reshape(shape)
