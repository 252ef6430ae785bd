"""Merging of Gaussians into fewer ones that look the same, each representing its neighbors.

Some Gaussians are kept: the most visible ones, and an even sample of the rest along a space-filling curve (Morton,
1966). Each of the others joins the nearest kept one. A group becomes one Gaussian with its mean, covariance and color,
weighted by opacity times area, and with the opacity that covers the same area (moment matching; as in Kerbl et al., A
Hierarchical 3D Gaussian Representation, 2024, section 4.1).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64

from epipole.geometry import Rotation3
from epipole.report.gaussians import log_visibility, most_visible
from epipole.scene.gaussian_cloud import GaussianCloud

KEPT_FRACTION = 0.1
"""Fraction of the kept Gaussians chosen by visibility; the rest covers space evenly."""
_MORTON_BITS = 21
_MOST_OPACITY = 0.995
_LEAST_OPACITY = 1e-4
_SPREADS = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def merged(cloud: GaussianCloud, most: int) -> GaussianCloud:
    """Merge Gaussians into at most `most` that look the same.

    Args:
        cloud: all Gaussians.
        most: largest number of Gaussians in the result, at least 1.
    """
    from scipy.spatial import cKDTree

    if len(cloud) <= most:
        return cloud
    means = cloud.means_in_world.astype(np.float64)
    kept = _kept(cloud, means, most)
    group = cKDTree(means[kept]).query(means)[1].astype(np.int64)
    group[kept] = np.arange(len(kept))  # in case two have the same position
    return _moments(cloud, means, kept, group)


def _kept(cloud: GaussianCloud, means: np.ndarray, most: int) -> Int64[np.ndarray, " m"]:
    """Rows of the most visible Gaussians, and of an even spatial sample of the others."""
    visible = most_visible(cloud, int(KEPT_FRACTION * most))
    is_left = np.ones(len(cloud), bool)
    is_left[visible] = False
    left = np.flatnonzero(is_left)
    left = left[np.argsort(_morton(means[left]), kind="stable")]
    even = left[np.linspace(0, len(left) - 1, most - len(visible)).astype(np.int64)]
    return np.sort(np.concatenate([visible, even]))


def _morton(points: np.ndarray) -> np.ndarray:
    """Morton codes: interleaved bits of the three coordinates, along a space-filling curve."""
    low = points.min(axis=0)
    side = max(float((points - low).max()), 1e-30)
    cells = ((points - low) / side * (2**_MORTON_BITS - 1)).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for axis in range(3):
        bits = cells[:, axis]
        for shift, mask in _SPREADS:
            bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
        code |= bits << np.uint64(axis)
    return code


def _moments(cloud: GaussianCloud, means: np.ndarray, kept: np.ndarray, group: np.ndarray) -> GaussianCloud:
    count = np.bincount(group, minlength=len(kept))
    joined = np.flatnonzero(count[group] > 1)  # all others stay unchanged
    of, rows = np.unique(group[joined], return_inverse=True)
    weight, log_total = _weights(log_visibility(cloud)[joined], rows, len(of))
    part = cloud.rows(joined)
    center = _sums(weight[:, None] * means[joined], rows, len(of))
    apart = means[joined] - center[rows]
    spread = _covariances(part) + apart[:, :, None] * apart[:, None, :]
    covariance = _sums(weight[:, None] * spread.reshape(-1, 9), rows, len(of)).reshape(-1, 3, 3)
    flat_sh = part.sh.reshape(len(part), -1).astype(np.float64)
    sh = _sums(weight[:, None] * flat_sh, rows, len(of)).reshape(-1, *cloud.sh.shape[1:])
    is_sound = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(sh).all(axis=(1, 2))
    covariance[~is_sound] = np.eye(3)
    variances, axes = np.linalg.eigh(covariance)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    log_scales = 0.5 * np.log(np.maximum(variances, 1e-30))
    opacity = np.exp(np.clip(log_total - log_scales[:, 1] - log_scales[:, 2], -50.0, 0.0))
    opacity = np.clip(opacity, _LEAST_OPACITY, _MOST_OPACITY)
    out = [array[kept].copy() for array in _arrays(cloud)]
    made = (center, log_scales, Rotation3(axes).as_quat_wxyz(), np.log(opacity / (1.0 - opacity)), sh)
    for array, values in zip(out, made):
        array[of[is_sound]] = values[is_sound]
    return GaussianCloud(*out)


def _weights(visible: np.ndarray, rows: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Each one's fraction of its group's visibility, and the logarithm of the group's sum."""
    largest = np.full(count, -np.inf)
    np.maximum.at(largest, rows, visible)
    weight = np.exp(visible - largest[rows])
    total = np.bincount(rows, weight, count)
    return weight / total[rows], largest + np.log(total)


def _sums(values: Float64[np.ndarray, "n k"], rows: np.ndarray, count: int) -> Float64[np.ndarray, "m k"]:
    return np.stack([np.bincount(rows, column, count) for column in values.T], axis=1)


def _covariances(cloud: GaussianCloud) -> Float64[np.ndarray, "n 3 3"]:
    quats = cloud.quats_wxyz.astype(np.float64)
    quats[~quats.any(axis=1)] = 1.0, 0.0, 0.0, 0.0
    world_from_own = Rotation3.from_quat_wxyz(quats).matrix
    spread = world_from_own * np.exp(np.clip(cloud.log_scales.astype(np.float64), -40.0, 40.0))[:, None, :]
    return spread @ np.swapaxes(spread, 1, 2)


def _arrays(cloud: GaussianCloud) -> tuple[np.ndarray, ...]:
    return cloud.means_in_world, cloud.log_scales, cloud.quats_wxyz, cloud.opacity_logits, cloud.sh
