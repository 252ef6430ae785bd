"""Growth of pose errors over those that independent pixel errors would cause.

A tracked point keeps its error from image to image, and its neighbors have similar ones. The scores of points, their
parts of the gradient, contain all of that: with H the normal matrix and g_c the score of a cluster of points, both after
elimination of the points, the covariance is H^-1 (sum g_c g_c^T) H^-1 (Liang and Zeger, Longitudinal data analysis using
generalized linear models, 1986; for clusters: Cameron and Miller, A practitioner's guide to cluster-robust inference,
2015). A few dozen clusters determine its size well, but not its shape, so only the size is used. A cluster pulls the
minimum toward itself by its fraction of the weight; this loss is corrected as by leaving out one cluster after another
(the jackknife, their CR3).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from epipole import _parallel
from epipole.optim import _bundle_arrays as arrays
from epipole.optim import _bundle_kernels as kernels
from epipole.optim import _bundle_reduced_kernels as reduced_kernels
from epipole.optim.bundle_layout import BundleLayout, BundleState
from epipole.optim.bundle_system import BundleSystem, Linearization
from epipole.optim.losses import Loss

MOST_CLUSTERS = 64
"""Clusters are runs of consecutive points: first observed together, and close to each other."""


def error_growth(
    system: BundleSystem,
    state: BundleState,
    linearized: Linearization,
    covariance: np.ndarray,
    loss: tuple[Loss, float],
) -> np.ndarray:
    """(nodes,) factors for the variances of nodes; 1 if unknown.

    Args:
        system: the system at a minimum.
        state: the minimum.
        linearized: the normal equations there, without damping.
        covariance: (nodes, lanes, lanes) for independent errors.
        loss: the loss, and its scale in pixels.
    """
    out = np.ones(len(covariance))
    factor = None if system.plan is None else system.plan.factorize(linearized.blocks)
    edges = np.unique(np.linspace(0, len(state.points), MOST_CLUSTERS + 1).astype(np.int64))
    count = len(edges) - 1
    if factor is None or count < 2:
        return out
    own = np.arange(len(system.layout.lanes)) < system.layout.entries.width[:, None]
    steps, seen = np.zeros((count, *own.shape)), np.zeros((count, len(own)))
    for c, (score, weight) in enumerate(_scores(system, state, edges, (int(loss[0]), float(loss[1] ** 2)))):
        steps[c][own], seen[c] = factor.solve(score[own]), weight
    fraction = seen / np.maximum(seen.sum(axis=0), 1e-300)
    lost = 1.0 / np.maximum(1.0 - (fraction**2).sum(axis=0), 0.5) ** 2
    free = own & ~system.layout.fixed_mask
    for n in range(len(covariance)):
        known, step = covariance[n][np.ix_(free[n], free[n])], steps[:, n, free[n]]
        unit = np.sqrt(np.einsum("ii->i", known))
        if known.size and (unit > 0).all() and np.isfinite(unit).all():
            white = np.linalg.solve(known / np.outer(unit, unit), (step / unit).T).T
            out[n] = lost[n] * _mean_of_samples(((step / unit) * white).sum(axis=1) / len(known))
    return out if system.problem.priors is None else np.maximum(out, 1.0)  # a prior's errors have no score


def _mean_of_samples(parts: np.ndarray) -> float:
    """The sum over clusters, enlarged if few clusters dominate it.

    With nu = 2 sum^2 / var degrees of freedom (Satterthwaite 1946), errors relative to their stated deviation have Student's
    distribution, with variance nu / (nu - 2).
    """
    total, count = float(parts.sum()), len(parts)
    variance = count * float(parts.var(ddof=1))
    freedom = max(2.0 * total**2 / max(variance, 1e-300), 4.0)
    return total * freedom / (freedom - 2.0)


def _scores(
    system: BundleSystem, state: BundleState, edges: np.ndarray, loss: tuple[int, float]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each cluster of points its reduced gradient (nodes, lanes), points eliminated, and its weight in nodes (nodes,)."""
    layout, scene = system.layout, system.layout.scene(state)
    kept = arrays.Eliminated(*(arrays.rows_of_zeros(part.shape) for part in system.kept))
    images, wide, lanes = len(layout.images.frame), len(layout.wide), len(layout.lanes)
    nowhere = np.full((images, 3, 3), -1, np.int64)
    no_blocks = arrays.rows_of_zeros((1, lanes, lanes))
    stays = np.flatnonzero(layout.nodes.point >= 0)

    def scores(start: int, stop: int, _chunk: int) -> list[tuple[np.ndarray, np.ndarray]]:
        shapes = (images, wide, wide), (images, wide), (layout.num_nodes, lanes), (layout.num_nodes, lanes)
        normal, gradient_of_images, eliminated, gradient = map(arrays.rows_of_zeros, shapes)
        sums, scratch, found = (normal, gradient_of_images, eliminated), kernels.make_scratch(wide), []
        for first, last in pairwise(edges[start : stop + 1].tolist()):
            for part in (*sums, gradient):
                part.fill(0.0)
            points = layout.observations, first, last, scene, layout.unknowns, layout.entries
            kernels.linearize(*points, *loss, 0.0, kept, sums, layout.lanes, layout.wide, scratch)
            reduced_kernels.add_images(
                layout.unknowns, normal, gradient_of_images, nowhere, no_blocks, gradient, layout.wide
            )
            for j in stays[(stays >= first) & (stays < last)]:
                gradient[layout.nodes.point[j], :3] += kept.h[j]
            found.append((gradient - eliminated, _weight_of_nodes(layout, normal)))
        return found

    return [score for part in _parallel.map_chunks(scores, len(edges) - 1) for score in part]


def _weight_of_nodes(layout: BundleLayout, normal: np.ndarray) -> np.ndarray:
    """(nodes,) sum of the diagonals of the images' normal matrices."""
    weight, of_image = np.zeros(layout.num_nodes), np.einsum("iaa->i", normal)
    for nodes in layout.unknowns.nodes.T:
        met = nodes >= 0
        weight += np.bincount(nodes[met], of_image[met], layout.num_nodes)
    return weight
