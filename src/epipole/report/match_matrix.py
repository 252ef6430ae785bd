"""Verified pairs as compact data for the match matrix."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool

from epipole.robust import PairKind
from epipole.scene import ViewGraph


def match_matrix_payload(graph: ViewGraph, is_registered: Bool[np.ndarray, " n"]) -> dict[str, Any]:
    """One entry per pair: its images, inliers, kind and angle; and which images are registered."""
    angles = np.rad2deg(graph.median_angle_rad)
    return {
        "n": len(is_registered),
        "placed": np.flatnonzero(is_registered).tolist(),
        "first": graph.image1.tolist(),
        "second": graph.image2.tolist(),
        "count": graph.num_inliers().tolist(),
        "putative": graph.num_putative.tolist(),
        "kind": graph.kind.tolist(),
        "kinds": {str(int(kind)): kind.name.lower() for kind in PairKind},
        "angle": [round(float(a), 1) if np.isfinite(a) else None for a in angles],
    }
