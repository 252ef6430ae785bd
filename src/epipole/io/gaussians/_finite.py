"""Final step of every Gaussian reader: removal of non-finite Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from epipole.errors import FileFormatError
from epipole.scene.gaussian_cloud import GaussianCloud
from epipole.scene.local_origin import local_origin

MOST_GAUSSIANS = 100_000_000
MOST_LOGIT = 15.0
"""Logit of an opacity stored as 0 or 1."""
LEAST_LOG_SCALE = -30.0
"""Log scale of a standard deviation stored as 0."""


def finite_gaussians(
    path: Path, parts: Sequence[np.ndarray], origin_in_world: np.ndarray | None = None
) -> GaussianCloud:
    """Keep the finite Gaussians, and move the origin near them if they are far from the file's origin.

    Args:
        path: the file, for error messages.
        parts: means (may be double precision), log scales, quaternions, opacity logits and harmonics. A zero quaternion
            becomes the identity, an infinite logit an opacity of 1 or 0, and a log scale of minus infinity a flat
            Gaussian.
        origin_in_world: offset stored in the file, to be added to the means; None: zero.

    Raises:
        FileFormatError: no Gaussian is finite.
    """
    n, means = len(parts[0]), parts[0]
    with np.errstate(over="ignore", invalid="ignore"):  # overflow becomes infinite
        log_scales, quats, logits, sh = (part.astype(np.float32) for part in parts[1:])
    logits = np.where(np.isinf(logits), np.sign(logits) * MOST_LOGIT, logits)
    log_scales = np.where(log_scales == -np.inf, LEAST_LOG_SCALE, log_scales)
    with np.errstate(over="ignore", invalid="ignore"):  # values of a damaged file
        rotated = (quats**2).sum(axis=1, keepdims=True) != 0
    quats = np.where(rotated, quats, np.array([1, 0, 0, 0], np.float32))
    whole = (means, log_scales, quats, logits, sh)
    good = np.all([np.isfinite(part).all(axis=tuple(range(1, part.ndim))) for part in whole], axis=0)
    if not good.any():
        raise FileFormatError(path, f"none of its {n} Gaussians is finite" if n else "no Gaussians in it")
    centers = means[good].astype(np.float64)
    near = local_origin(centers)
    log_scales, quats, logits, sh = (np.ascontiguousarray(part[good], np.float32) for part in whole[1:])
    origin = near if origin_in_world is None else origin_in_world + near
    return GaussianCloud((centers - near).astype(np.float32), log_scales, quats, logits, sh, origin)
