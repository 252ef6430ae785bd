"""The sparse factorization's steps against dense algebra, definitions and the interpreter."""

import numpy as np
import pytest

from epipole.optim import _cholesky_kernels as kernels
from epipole.optim import block_cholesky
from epipole.optim.block_cholesky import BlockPattern, CholeskyPlan, plan_cholesky
from kernel_references import assert_same_as_python, record_calls, reference_of

SIZES = [(1, 0), (2, 1), (6, 3), (14, 12), (9, 0), (60, 70)]
every_size = pytest.mark.parametrize(("num_nodes", "num_edges"), SIZES)


def random_pattern(rng: np.random.Generator, num_nodes: int, num_edges: int) -> BlockPattern:
    """Blocks on the diagonal and at random places below it."""
    ends = rng.integers(0, num_nodes, (num_edges, 2))
    diagonal = np.arange(num_nodes)
    pairs = np.unique(np.vstack([np.stack([diagonal, diagonal], 1), np.sort(ends, axis=1)[:, ::-1]]), axis=0)
    return BlockPattern(rng.integers(1, 7, num_nodes), pairs[:, 0].copy(), pairs[:, 1].copy())


def factored_structure(pattern: BlockPattern, order: np.ndarray) -> np.ndarray:
    """Where the factor has blocks, by elimination as in the book."""
    n = len(order)
    position = np.argsort(order)
    full = np.eye(n, dtype=bool)
    full[position[pattern.row], position[pattern.column]] = full[
        position[pattern.column], position[pattern.row]
    ] = True
    for j in range(n):
        below = np.flatnonzero(full[j + 1 :, j]) + j + 1
        full[np.ix_(below, below)] = True
    return np.tril(full)


@every_size
@reference_of(
    kernels.elimination_tree,
    kernels.postorder,
    kernels.column_structure,
    kernels.merge_columns,
    kernels.rows_in_parents,
    kernels.assign_blocks,
)
def test_the_plan_is_made_as_written(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, num_nodes: int, num_edges: int
) -> None:
    steps = (
        *(kernels.elimination_tree, kernels.postorder, kernels.column_structure),
        *(kernels.merge_columns, kernels.rows_in_parents, kernels.assign_blocks),
    )
    calls = {step: record_calls(monkeypatch, block_cholesky, step) for step in steps}
    pattern = random_pattern(rng, num_nodes, num_edges)
    plan = plan_cholesky(pattern)
    after = {}
    for step, recorded in calls.items():
        assert recorded
        for arguments in recorded:
            _, after[step] = assert_same_as_python(step, *arguments)

    structure = factored_structure(pattern, plan.order)
    below = [np.flatnonzero(column)[1:] for column in structure.T]
    parent = after[kernels.elimination_tree][2]
    np.testing.assert_array_equal(parent, [rows[0] if len(rows) else -1 for rows in below])
    order, old_parent = after[kernels.postorder][3], after[kernels.postorder][0]
    position = np.argsort(order)
    child = np.flatnonzero(old_parent >= 0)
    assert (position[child] < position[old_parent[child]]).all()
    _, _, _, _, start, fill, row = after[kernels.column_structure]
    np.testing.assert_array_equal(fill, [len(rows) for rows in below])
    np.testing.assert_array_equal(row, np.concatenate(below) if len(row) else [])
    np.testing.assert_array_equal(np.diff(start), fill)
    assert_supernodes_hold(plan, structure)


def assert_supernodes_hold(plan: CholeskyPlan, structure: np.ndarray) -> None:
    """Every block of the factor has a row in its supernode's front, at the scalar that the rows before it leave."""
    nodes = plan.supernodes
    size = np.diff(nodes.scalar_of_slot)
    front = []
    for s in range(len(nodes.parent)):
        rows = nodes.row[nodes.row_start[s] : nodes.row_start[s + 1]]
        positions = np.concatenate([np.arange(nodes.first[s], nodes.first[s + 1]), rows])
        front.append(dict(zip(positions.tolist(), np.cumsum([0, *size[positions]]).tolist())))
        for j in range(nodes.first[s], nodes.first[s + 1]):
            assert set(np.flatnonzero(structure[:, j])) <= set(positions)
    for s, above in enumerate(nodes.parent):
        for e in range(nodes.row_start[s], nodes.row_start[s + 1]):
            assert nodes.row_in_parent[e] == front[above][int(nodes.row[e])]
        for e in range(nodes.block_start[s], nodes.block_start[s + 1]):
            ends = np.argsort(plan.order)[
                [plan.pattern.row[nodes.block[e]], plan.pattern.column[nodes.block[e]]]
            ]
            assert nodes.block_row[e] == front[s][int(ends.max())]
            assert nodes.block_column[e] == front[s][int(ends.min())]


def dense_matrix(rng: np.random.Generator, pattern: BlockPattern) -> tuple[np.ndarray, np.ndarray]:
    """A definite matrix of this pattern: its blocks, and whole."""
    first = np.concatenate([[0], np.cumsum(pattern.size)])
    owner = np.repeat(np.arange(len(pattern.size)), pattern.size)
    there = np.zeros((len(pattern.size),) * 2, bool)
    there[pattern.row, pattern.column] = there[pattern.column, pattern.row] = True
    values = rng.normal(size=(first[-1],) * 2) * there[np.ix_(owner, owner)]
    dense = values + values.T + np.eye(first[-1]) * (1.0 + 2.0 * np.abs(values + values.T).sum(axis=1))
    width = int(pattern.size.max())
    blocks = np.full((len(pattern.row), width, width), np.nan)  # what lies beyond a block is not looked at
    for b, (i, j) in enumerate(zip(pattern.row, pattern.column)):
        part = dense[first[i] : first[i + 1], first[j] : first[j + 1]]
        blocks[b, : part.shape[0], : part.shape[1]] = part
    return blocks, dense


def scalars_in_order(plan: CholeskyPlan) -> np.ndarray:
    first = np.concatenate([[0], np.cumsum(plan.pattern.size)])
    return np.concatenate([np.arange(first[i], first[i + 1]) for i in plan.order])


def factor_of_panels(plan: CholeskyPlan, panels: np.ndarray) -> np.ndarray:
    nodes = plan.supernodes
    at = nodes.scalar_of_slot
    factor = np.zeros((at[-1], at[-1]))
    for s in range(len(nodes.parent)):
        positions = [
            *range(nodes.first[s], nodes.first[s + 1]),
            *nodes.row[nodes.row_start[s] : nodes.row_start[s + 1]],
        ]
        rows = np.concatenate([np.arange(at[p], at[p + 1]) for p in positions])
        m, k = nodes.num_rows[s], nodes.num_pivots[s]
        own = panels[nodes.panel_start[s] : nodes.panel_start[s] + m * k].reshape(k, m).T
        factor[np.ix_(rows, rows[:k])] = own
    return np.tril(factor)


@every_size
@reference_of(kernels.factor_supernodes, kernels.solve_supernodes)
def test_the_factor_is_the_dense_one(rng: np.random.Generator, num_nodes: int, num_edges: int) -> None:
    """BLAS is called by address, which Python cannot do: the reference is NumPy's factor of the whole matrix."""
    pattern = random_pattern(rng, num_nodes, num_edges)
    plan = plan_cholesky(pattern)
    blocks, dense = dense_matrix(rng, pattern)
    chosen = np.concatenate(plan.groups)
    panels, updates = np.empty(plan.panel_size), np.empty(plan.update_size)
    assert kernels.factor_supernodes(plan.supernodes, chosen, blocks, panels, updates, np.zeros(4, np.int32))
    order = scalars_in_order(plan)
    rotated = dense[np.ix_(order, order)]
    factor = factor_of_panels(plan, panels)
    np.testing.assert_allclose(factor, np.linalg.cholesky(rotated), atol=1e-12 * np.abs(dense).max())

    x = rng.normal(size=len(dense))
    expected = np.linalg.solve(rotated, x)
    work = np.empty(int(plan.supernodes.num_rows.max()))
    kernels.solve_supernodes(plan.supernodes, panels, x, np.zeros(4, np.int32), work)
    np.testing.assert_allclose(x, expected, rtol=1e-9, atol=1e-12)

    is_definite = kernels.factor_supernodes(
        plan.supernodes, chosen, -blocks, panels, updates, np.zeros(4, np.int32)
    )
    assert not is_definite
