"""Columns of a growing model: those that kernels read, a saved state, and their conversion for a finished model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from epipole.geometry import Rigid3
from epipole.scene import unregistered


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


def mean_colors(
    colors: Sequence[np.ndarray] | None, keypoint: np.ndarray, offsets: np.ndarray
) -> UInt8[np.ndarray, "p 3"]:
    """Mean colors of points.

    Args:
        colors: RGB of every keypoint of every image; None: gray 128.
        keypoint: keypoints of each point, grouped by point, counted over all images.
        offsets: where the keypoints of each point start and end.
    """
    if colors is None or len(offsets) < 2:
        return np.full((len(offsets) - 1, 3), 128, np.uint8)
    seen = np.concatenate(list(colors))[keypoint].astype(np.float64)
    return np.rint(np.add.reduceat(seen, offsets[:-1], axis=0) / np.diff(offsets)[:, None]).astype(np.uint8)


def poses_of(registered: np.ndarray, motion: np.ndarray) -> Rigid3:
    """cam_from_world of all images; NaN for those that are not registered."""
    poses = unregistered(len(registered))
    poses.rotation[registered] = motion[registered, :9].reshape(-1, 3, 3)
    poses.translation[registered] = motion[registered, 9:]
    return poses
