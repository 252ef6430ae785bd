"""Color offsets that make charts of different views meet without a seam."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import cg

from epipole.dense.texturing.charts import Charts

SMOOTHNESS = 10.0
"""Weight of differences between neighbors of a chart against those across a seam (1 / lambda of Waechter et al.)."""
RIDGE = 1e-3
"""Weight of the offsets themselves."""
MOST_DIFFERENCE = 90.0
"""Largest difference across a seam that is due to light; larger ones are due to a wrong position."""
ITERATIONS, TOLERANCE = 150, 1e-3


def color_offsets(faces: np.ndarray, charts: Charts, colors: np.ndarray) -> np.ndarray:
    """(m, 3, 3) offset of the color at each corner of each face (Waechter, Moehrle and Goesele, ECCV 2014, eq. 4).

    Each vertex of a chart has an offset. They minimize the squared differences of colors with offsets across seams, plus those of offsets
    along the edges of a chart.

    Args:
        faces: (m, 3) vertices.
        charts: the charts.
        colors: (m, 3, 3) color of each corner in the view of its face; NaN where unknown.
    """
    num_vertices = int(faces.max()) + 1
    keys = charts.chart_of_face[:, None] * num_vertices + faces
    nodes, node_of_corner = np.unique(keys, return_inverse=True)
    node_of_corner = node_of_corner.reshape(faces.shape)
    n = len(nodes)
    color = np.full((n, 3), np.nan)
    color[node_of_corner] = colors
    one, other = _across_seams(nodes % num_vertices, color)
    inside = np.sort(node_of_corner[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    inside = np.unique(inside[:, 0] * n + inside[:, 1])
    matrix = _laplacian(one, other, n) + SMOOTHNESS * _laplacian(inside // n, inside % n, n)
    matrix = csr_array(matrix + diags_array(np.full(n, RIDGE)))
    preconditioner = diags_array(1.0 / matrix.diagonal())
    out = np.zeros((n, 3))
    for k in range(3):
        difference = color[other, k] - color[one, k]
        right = np.bincount(one, difference, minlength=n) - np.bincount(other, difference, minlength=n)
        out[:, k] = cg(matrix, right, rtol=TOLERANCE, maxiter=ITERATIONS, M=preconditioner)[0]
    return np.asarray(out[node_of_corner])


def _across_seams(vertex: np.ndarray, color: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of nodes of one vertex in different charts, whose colors are known and similar."""
    known = np.flatnonzero(np.isfinite(color).all(axis=1))
    row = known[np.argsort(vertex[known], kind="stable")]
    same = vertex[row[1:]] == vertex[row[:-1]]
    one, other = row[:-1][same], row[1:][same]
    near = np.abs(color[one] - color[other]).max(axis=1, initial=0.0) <= MOST_DIFFERENCE
    return one[near], other[near]


def _laplacian(one: np.ndarray, other: np.ndarray, n: int) -> csr_array:
    """Matrix of the sum of squared differences between pairs of nodes."""
    ones = np.ones(len(one))
    off = coo_array((-ones, (one, other)), shape=(n, n)).tocsr()
    degree = np.bincount(one, minlength=n) + np.bincount(other, minlength=n)
    return csr_array(off + off.T + diags_array(degree.astype(np.float64)))
