"""Pose graphs with false edges: graduated non-convexity (Yang, Antonante, Tzoumas and Carlone, RA-L 2020)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool
from scipy.special import chdtri

from epipole import _parallel
from epipole._checks import checked
from epipole.config import options_of
from epipole.errors import ShapeError
from epipole.optim.pose_graph import (
    Motion,
    PoseGraph,
    PoseGraphConfig,
    PoseGraphResult,
    optimize_weighted,
    pose_graph_cost,
)


@checked
def optimize_pose_graph_robustly(
    graph: PoseGraph,
    may_be_wrong_mask: Bool[np.ndarray, " m"] | None = None,
    config: PoseGraphConfig | None = None,
) -> PoseGraphResult:
    """Graduated non-convexity with truncated least squares (Yang, Antonante, Tzoumas and Carlone, RA-L 2020).

    The loss starts nearly quadratic and hardens until each edge counts fully or not at all.

    Args:
        graph: poses and edges.
        may_be_wrong_mask: edges that may be false loop closures; None: all that do not connect consecutive poses.
        config: options; `confidence` sets the largest residual of an inlier edge.

    Raises:
        DegenerateGeometryError: an information matrix is not positive definite.
        ShapeError: the mask does not have one row per edge.
    """
    if may_be_wrong_mask is not None and len(may_be_wrong_mask) != len(graph.first):
        raise ShapeError(f"may_be_wrong_mask must have {len(graph.first)} rows, got {len(may_be_wrong_mask)}")
    with _parallel.single_threaded_blas():
        return _optimize_robustly(graph, may_be_wrong_mask, options_of(PoseGraphConfig, config))


def _optimize_robustly(
    graph: PoseGraph, may_be_wrong_mask: np.ndarray | None, config: PoseGraphConfig
) -> PoseGraphResult:
    doubtful = np.abs(graph.second - graph.first) != 1 if may_be_wrong_mask is None else may_be_wrong_mask
    bound = float(chdtri(graph.dimension, 1.0 - config.confidence))
    initial_cost = pose_graph_cost(graph)
    weights = np.ones(len(graph.first))
    current = optimize_weighted(
        graph, replace(config, max_iterations=20), np.where(doubtful, 1e-6, 1.0), None
    )
    squared = current.squared_residuals
    iterations = current.num_iterations
    worst = float(squared[doubtful].max(initial=0.0))
    mu = bound / max(2.0 * worst - bound, bound)
    for _ in range(200):
        high, low = (mu + 1.0) / mu * bound, mu / (mu + 1.0) * bound
        middle = np.sqrt(bound * mu * (mu + 1.0) / np.maximum(squared, 1e-300)) - mu
        soft = np.where(squared >= high, 0.0, np.where(squared <= low, 1.0, middle))
        weights = np.where(doubtful, np.clip(soft, 0.0, 1.0), 1.0)
        current = optimize_weighted(
            replace(graph, world_from_body=current.world_from_body),
            replace(config, max_iterations=2),
            weights,
            None,
        )
        squared, iterations = current.squared_residuals, iterations + current.num_iterations
        if ((weights == 0.0) | (weights == 1.0)).all() and mu > 1.0:
            break
        mu *= 1.4
    final = _converged(graph, config, current.world_from_body, ~doubtful | (weights > 0.5))
    found = _tightened(graph, config, final, doubtful, bound)
    return replace(found, initial_cost=initial_cost, num_iterations=iterations + found.num_iterations)


def _converged(
    graph: PoseGraph, config: PoseGraphConfig, positions: Motion, kept: np.ndarray
) -> PoseGraphResult:
    return optimize_weighted(replace(graph, world_from_body=positions), config, kept.astype(float), None)


def _tightened(
    graph: PoseGraph, config: PoseGraphConfig, found: PoseGraphResult, doubtful: np.ndarray, bound: float
) -> PoseGraphResult:
    """The same or a better selection of edges: thresholded at the observed noise, then at the stated noise.

    If information matrices state far more noise than there is, a false loop may bend the graph within their bounds. Against
    the median of all residuals it stands out.
    """
    claimed = float(chdtri(graph.dimension, 0.5))
    fraction = float(np.median(found.squared_residuals[found.kept_mask])) / claimed
    if not fraction < 0.5:
        return found
    tried = found
    for cut in (fraction * bound, fraction * bound, bound, bound):
        kept = ~doubtful | (tried.squared_residuals <= cut)
        tried = _converged(graph, config, tried.world_from_body, kept)
    truncated = [
        float(np.where(doubtful, np.minimum(r.squared_residuals, bound), r.squared_residuals).sum())
        for r in (found, tried)
    ]
    return tried if truncated[1] < truncated[0] else found
