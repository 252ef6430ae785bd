"""Gauge of an unconstrained map: adjustments leave it as close as possible to where it was."""

from __future__ import annotations

import numpy as np

from epipole.geometry import Rigid3, Similarity3, align_points


def align_gauge(after: Rigid3, before: Rigid3, *, with_scale: bool = True) -> Similarity3:
    """before_from_after of cameras (n,) whose gauge is free, from both their centers and their orientations."""
    marks = []
    for cams in (after, before):
        centers = cams.centers()
        size = max(float(np.sqrt(((centers - centers.mean(axis=0)) ** 2).sum(axis=1).mean())), 1e-9)
        marks.append(np.concatenate([centers, *(centers + size * cams.rotation[:, k] for k in range(3))]))
    return align_points(*marks, with_scale=with_scale)
