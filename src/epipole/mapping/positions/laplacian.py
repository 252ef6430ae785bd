"""Values at the nodes of a graph from the differences along its edges."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu

SMALLEST_PIVOT = 1e-12
"""Added to the diagonal, relative to its largest element: nodes whose edges all have no weight stay."""


def solve_laplacian(
    first: np.ndarray, second: np.ndarray, component: np.ndarray, weights: np.ndarray, differences: np.ndarray
) -> np.ndarray:
    """(n, d) values x that minimize sum w |x_second - x_first - difference|^2; zero at the first node of each component.

    Args:
        first: (p,) first node of each edge.
        second: (p,) second node.
        component: (n,) connected component of each node.
        weights: (p,) positive.
        differences: (p, d)
    """
    n, p = len(component), len(first)
    rows = np.concatenate([np.arange(p), np.arange(p)])
    signs = np.concatenate([-np.ones(p), np.ones(p)])
    A = sparse.csc_array((signs, (rows, np.concatenate([first, second]))), shape=(p, n))
    free = np.setdiff1d(np.arange(n), np.unique(component, return_index=True)[1])
    values = np.zeros((n, differences.shape[1]))
    if len(free):
        A = A[:, free]
        weighted = sparse.diags_array(weights) @ A
        normal = A.T @ weighted
        normal = sparse.csc_matrix(
            normal + SMALLEST_PIVOT * normal.diagonal().max() * sparse.eye_array(len(free))
        )
        values[free] = splu(normal).solve(weighted.T @ differences)
    return values
