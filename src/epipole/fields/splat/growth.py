"""Densification: Gaussians with the largest image-space gradient are split, transparent ones are removed."""

from __future__ import annotations

import numpy as np

from epipole.fields.splat.rasterizer import Cloud
from epipole.geometry import Rotation3

LEAST_OPACITY = 0.005
"""Gaussians with a lower opacity are invisible in all images."""
APART = 0.5
"""Distance of the two parts of a split Gaussian from its center, in standard deviations along its longest axis."""
NARROWER = 0.5
"""Factor of the standard deviation along the longest axis."""
THINNER = 0.85
"""Factor of the other two standard deviations."""
FAINTER = 0.6
"""Factor of the opacity."""


class Growth:
    """Mean image-space gradient of each Gaussian since the last change (Kerbl et al. 2023, section 5.2).

    Attributes:
        grad2d: (n,) sum of gradient norms.
        views: (n,) number of views that saw each Gaussian.
    """

    def __init__(self, count: int) -> None:
        self.grad2d, self.views = np.zeros(count, np.float32), np.zeros(count, np.float32)

    def add(self, by_center: np.ndarray, is_visible: np.ndarray, width: int) -> None:
        """Add the norms of a view's gradients (n, 2), in units of half the image width, so that resolutions can be mixed."""
        x, y = by_center[is_visible].T
        self.grad2d[is_visible] += np.float32(0.5 * width) * np.sqrt(x * x + y * y)
        self.views[is_visible] += 1.0

    def changes(self, cloud: Cloud, wanted: int) -> tuple[np.ndarray, np.ndarray]:
        """Rows to split, largest mean gradient first, and a mask of rows to keep; at most `wanted` Gaussians result."""
        stays = cloud.logits > np.float32(np.log(LEAST_OPACITY / (1 - LEAST_OPACITY)))
        if not stays.any():
            stays[:] = True
        score = np.where(stays & (self.views > 0), self.grad2d / np.maximum(self.views, 1.0), 0.0)
        room = max(0, min(wanted - int(stays.sum()), int((score > 0).sum())))
        return np.argsort(-score, kind="stable")[:room], stays


def split(cloud: Cloud, rows: np.ndarray) -> tuple[Cloud, Cloud]:
    """Split each Gaussian into two along its longest axis."""
    longest = cloud.log_scales[rows].argmax(axis=1)
    own = np.arange(len(rows))
    axes = Rotation3.from_quat_wxyz(cloud.quats_wxyz[rows].astype(np.float64)).matrix
    size = np.exp(cloud.log_scales[rows, longest].astype(np.float64))
    shift = (APART * size[:, None] * axes[own, :, longest]).astype(np.float32)
    scales = cloud.log_scales[rows] + np.float32(np.log(THINNER))
    scales[own, longest] += np.float32(np.log(NARROWER / THINNER))
    opacity = FAINTER / (1.0 + np.exp(-cloud.logits[rows].astype(np.float64)))
    logits = np.log(opacity / (1.0 - opacity)).astype(np.float32)
    both = [
        Cloud(cloud.means[rows] + offset * shift, scales, cloud.quats_wxyz[rows], logits, cloud.sh[rows])
        for offset in (np.float32(1.0), np.float32(-1.0))
    ]
    return both[0], both[1]
