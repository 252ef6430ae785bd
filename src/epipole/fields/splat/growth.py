"""Where Gaussians are needed: those whose images pull hardest at them are split, those that nobody sees go."""

from __future__ import annotations

import numpy as np

from epipole.fields.splat.rasterizer import Cloud
from epipole.geometry import Rotation3

LEAST_OPACITY = 0.005
"""A Gaussian that is fainter shows in no image."""
APART, NARROWER, THINNER, FAINTER = 0.5, 0.5, 0.85, 0.6
"""Of the two parts of a Gaussian: their distance from its middle in its longest deviation, and what becomes of that deviation, of the
others and of the opacity."""


class Growth:
    """Scores since the last change: the mean pull at where each Gaussian is seen (Kerbl et al. 2023, section 5.2).

    Attributes:
        pull: (n,) summed.
        views: (n,) in which each was seen.
    """

    def __init__(self, count: int) -> None:
        self.grad2d, self.views = np.zeros(count, np.float32), np.zeros(count, np.float32)

    def add(self, grad2d: np.ndarray, seen: np.ndarray, width: int) -> None:
        """Count a view: pulls are told in shares of the image's width, so that sizes can be mixed."""
        self.grad2d[seen] += np.float32(0.5 * width) * grad2d
        self.views[seen] += 1.0

    def changes(self, cloud: Cloud, wanted: int) -> tuple[np.ndarray, np.ndarray]:
        """Rows to split, those with the largest mean pull first, and a mask of those that stay; at most `wanted` in the end."""
        stays = cloud.logits > np.float32(np.log(LEAST_OPACITY / (1 - LEAST_OPACITY)))
        if not stays.any():
            stays[:] = True
        score = np.where(stays & (self.views > 0), self.grad2d / np.maximum(self.views, 1.0), 0.0)
        room = max(0, min(wanted - int(stays.sum()), int((score > 0).sum())))
        return np.argsort(-score, kind="stable")[:room], stays


def split(cloud: Cloud, rows: np.ndarray) -> tuple[Cloud, Cloud]:
    """Two parts of each Gaussian, side by side along its longest axis."""
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
