"""Focal lengths from fundamental matrices: self-calibration of cameras about which nothing is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from epipole.robust import PairKind
from epipole.scene import Cameras, ViewGraph

NUM_STEPS = 60
MIN_PAIRS = 1
MIN_INLIERS = 50


def estimate_focals(
    cameras: Cameras, camera_of_image: np.ndarray, view_graph: ViewGraph
) -> tuple[Cameras, dict[int, float]]:
    """Guess the focal lengths of untrusted cameras from the pairs that one camera took.

    An essential matrix has two equal singular values (Huang and Faugeras, PAMI 1989), so that the focal length
    of K^T F K is right where they agree best. Every pair votes over a logarithmic range; the votes are added,
    weighted by inliers and bounded, so that planar and forward-moving pairs, whose votes are flat or wrong, do
    not decide. (Searching the range in place of solving for it: Mendonca and Cipolla, CVPR 1999.)

    Returns:
        Cameras with the new guesses, and the factor found for each camera that got one.
    """
    params, trusted, found = cameras.params.copy(), cameras.is_focal_trusted.copy(), {}
    usable = (view_graph.kind == PairKind.UNCALIBRATED) & (view_graph.num_inliers() >= MIN_INLIERS)
    first, second = camera_of_image[view_graph.image1], camera_of_image[view_graph.image2]
    for c in np.flatnonzero(~cameras.is_focal_trusted & ~cameras.is_constant):
        pairs = np.flatnonzero(usable & (first == c) & (second == c))
        if len(pairs) < MIN_PAIRS:
            continue
        camera = cameras[int(c)]
        factors = np.geomspace(0.25, 4.0, NUM_STEPS)
        votes = np.zeros(NUM_STEPS)
        for n, factor in enumerate(factors):
            K = camera.K * np.array([[factor], [factor], [1.0]])
            K[:2, 2] = camera.K[:2, 2]
            s = np.linalg.svd(K.T @ view_graph.fundamental[pairs] @ K, compute_uv=False)
            disagreement = 1.0 - s[:, 1] / s[:, 0]
            weight = np.minimum(view_graph.num_inliers()[pairs], 500)
            votes[n] = (weight / (1.0 + (disagreement / 0.02) ** 2)).sum()
        best = int(np.argmax(votes))
        # A flat vote tells nothing: the guess stays.
        if votes[best] < 2.0 * np.median(votes) or best in (0, NUM_STEPS - 1):
            continue
        found[int(c)] = float(factors[best])
        for index in camera.model.focal_indices:
            params[c, index] *= factors[best]
        trusted[c] = True
    return replace(cameras, params=params, is_focal_trusted=trusted), found
