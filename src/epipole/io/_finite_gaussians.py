"""The end of every reader of Gaussians: what is not finite goes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from epipole.errors import FileFormatError
from epipole.scene.gaussian_cloud import GaussianCloud

MOST_GAUSSIANS = 100_000_000
MOST_LOGIT = 15.0
"""Of an opacity that a file holds as 0 or 1."""


def finite_gaussians(path: Path, parts: Sequence[np.ndarray]) -> GaussianCloud:
    """A cloud of those that are finite.

    Args:
        path: the file, for the message.
        parts: means, logarithms of deviations, rotations, logits and harmonics, float32; a rotation of length zero is taken as none.

    Raises:
        FileFormatError: none is.
    """
    n = len(parts[0])
    means, log_scales, quats, logits, sh = parts
    with np.errstate(over="ignore"):
        turned = (quats**2).sum(axis=1, keepdims=True) != 0
    quats = np.where(turned, quats, np.array([1, 0, 0, 0], np.float32))
    whole = (means, log_scales, quats, logits, sh)
    good = np.all([np.isfinite(part).all(axis=tuple(range(1, part.ndim))) for part in whole], axis=0)
    if not good.any():
        raise FileFormatError(path, f"none of its {n} Gaussians is finite" if n else "holds no Gaussian")
    return GaussianCloud(*(np.ascontiguousarray(part[good]) for part in whole))
