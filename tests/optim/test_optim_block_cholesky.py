"""The block Cholesky factorization solves, inverts where asked, and says when a matrix is not definite."""

import numpy as np
import pytest

from epipole import _parallel
from epipole.errors import ShapeError
from epipole.optim.block_cholesky import BlockPattern, plan_cholesky


def random_matrix(rng, num_nodes, num_edges, width, chain=0.8):
    """A diagonally dominant matrix of blocks of many sizes, with what is needed to check it."""
    size = rng.integers(1, width + 1, num_nodes)
    pairs = {(i, i) for i in range(num_nodes)}
    pairs |= {(i, i - 1) for i in range(1, num_nodes) if rng.random() < chain}
    for a, b in rng.integers(0, num_nodes, (num_edges, 2)):
        pairs.add((max(a, b), min(a, b)))
    row, column = np.array(sorted(pairs)).T
    first = np.concatenate([[0], np.cumsum(size)])
    dense = np.zeros((first[-1], first[-1]))
    for i, j in zip(row, column):
        block = rng.normal(size=(size[i], size[j]))
        dense[first[i] : first[i + 1], first[j] : first[j + 1]] = block
        dense[first[j] : first[j + 1], first[i] : first[i + 1]] = block.T
    dense = 0.5 * (dense + dense.T) + np.eye(len(dense)) * np.abs(dense).sum(axis=1).max()
    blocks = np.zeros((len(row), width, width))
    for b, (i, j) in enumerate(zip(row, column)):
        blocks[b, : size[i], : size[j]] = dense[first[i] : first[i + 1], first[j] : first[j + 1]]
    return BlockPattern(size, row, column), blocks, dense, first


@pytest.mark.parametrize(
    ("num_nodes", "num_edges", "width"),
    [(1, 0, 3), (2, 1, 2), (5, 3, 3), (40, 30, 6), (300, 80, 6), (60, 2000, 3), (120, 0, 14)],
)
def test_solves_and_inverts_as_dense_algebra_does(rng, num_nodes, num_edges, width):
    pattern, blocks, dense, first = random_matrix(rng, num_nodes, num_edges, width)
    for last in (None, np.arange(num_nodes) < num_nodes // 10):
        factor = plan_cholesky(pattern, last).factorize(blocks)
        rhs = rng.normal(size=len(dense))
        np.testing.assert_allclose(factor.solve(rhs), np.linalg.solve(dense, rhs), rtol=1e-9, atol=1e-13)
        inverse, selected = np.linalg.inv(dense), factor.selected_inverse()
        for b, (i, j) in enumerate(zip(pattern.row, pattern.column)):
            expected = inverse[first[i] : first[i + 1], first[j] : first[j + 1]]
            np.testing.assert_allclose(
                selected[b, : len(expected), : expected.shape[1]], expected, atol=1e-14
            )


def test_parts_that_do_not_meet_are_factored_too(rng):
    pattern, blocks, dense, _ = random_matrix(rng, 50, 5, 4, chain=0.3)
    rhs = rng.normal(size=len(dense))
    found = plan_cholesky(pattern).factorize(blocks).solve(rhs)
    np.testing.assert_allclose(dense @ found, rhs, atol=1e-10)


def test_a_matrix_that_is_not_definite_has_no_factor(rng):
    pattern, blocks, _, _ = random_matrix(rng, 30, 20, 4)
    assert plan_cholesky(pattern).factorize(-blocks) is None
    blocks[np.flatnonzero((pattern.row == 17) & (pattern.column == 17))] *= -1.0
    assert plan_cholesky(pattern).factorize(blocks) is None


def test_the_factor_is_the_same_for_any_number_of_threads(rng):
    pattern, blocks, dense, _ = random_matrix(rng, 900, 500, 6)
    plan = plan_cholesky(pattern)
    assert len(plan.groups) > 2, "too small to be cut into subtrees"
    panels = []
    for threads in (1, 3):
        _parallel.set_num_threads(threads)
        with _parallel.single_threaded_blas():
            panels.append(plan.factorize(blocks).panels)
    _parallel.set_num_threads(None)
    np.testing.assert_array_equal(*panels)
    rhs = rng.normal(size=len(dense))
    found = plan.factorize(blocks).solve(rhs)
    np.testing.assert_allclose(dense @ found, rhs, atol=1e-9)


def test_a_chain_stays_a_chain():
    """The factor of a chain grows with its length, not with its square: 108 entries a link and some zeros."""
    n = 2000
    row = np.concatenate([np.arange(n), np.arange(1, n)])
    column = np.concatenate([np.arange(n), np.arange(n - 1)])
    plan = plan_cholesky(BlockPattern(np.full(n, 6), row, column))
    assert plan.panel_size < 5 * 108 * n and plan.flops < 1e4 * n


def test_blocks_above_the_diagonal_or_of_no_node_raise():
    with pytest.raises(ShapeError, match="below the diagonal"):
        BlockPattern(np.array([2, 2]), np.array([0]), np.array([1]))
    with pytest.raises(ShapeError, match="does not exist"):
        BlockPattern(np.array([2, 2]), np.array([2]), np.array([1]))
