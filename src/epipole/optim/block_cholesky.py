"""Sparse Cholesky of block matrices: analyzed once, factored at every step.

For groups of unknowns that are coupled to few others: cameras with common points, poses connected by edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float64, Int64
from scipy.linalg import solve_triangular
from scipy.sparse.linalg import splu

from epipole import _parallel
from epipole._checks import check_fields, checked
from epipole.errors import ShapeError
from epipole.optim import _cholesky_kernels as kernels

_MIN_PARALLEL_FLOPS = 5e6
_TASKS = 8
_MOST_SCALARS = 1 << 20
_DENSE_FRACTION = 0.6
"""Fraction of nonzero blocks above which no ordering helps."""


@dataclass(frozen=True, slots=True, eq=False)
class BlockPattern:
    """Blocks of the lower triangle of a symmetric matrix, row >= column, each once, including the diagonal ones."""

    size: Int64[np.ndarray, " n"]
    """Number of scalars of each node."""
    row: Int64[np.ndarray, " b"]
    column: Int64[np.ndarray, " b"]

    def __post_init__(self) -> None:
        """Check the blocks.

        Raises:
            ShapeError: a block is above the diagonal or refers to a missing node.
        """
        check_fields(self)
        if len(self.row) != len(self.column) or (self.row < self.column).any():
            raise ShapeError("blocks must be on or below the diagonal")
        if not ((self.size > 0) & (self.size <= _MOST_SCALARS)).all():
            raise ShapeError(f"the size of a node must be from 1 to {_MOST_SCALARS}")
        if len(self.row) and (self.column.min() < 0 or self.row.max() >= len(self.size)):
            raise ShapeError(f"a block refers to a node that does not exist (there are {len(self.size)})")
        if np.count_nonzero(self.row == self.column) != len(self.size):
            raise ShapeError("every node must have one diagonal block")


@dataclass(frozen=True, slots=True, eq=False)
class CholeskyPlan:
    """Elimination order and symbolic factorization of a pattern."""

    pattern: BlockPattern
    order: Int64[np.ndarray, " n"]
    """The node eliminated at each step."""
    supernodes: kernels.Supernodes
    groups: tuple[np.ndarray, ...]
    """Supernodes of independent subtrees; the last group is all supernodes above them."""
    panel_size: int
    update_size: int
    flops: float

    @checked
    def factorize(self, blocks: Float64[np.ndarray, "b w w"]) -> BlockFactor | None:
        """The factor of the matrix with these blocks (padded to one size); None if it is not positive definite.

        Callers must limit BLAS to one thread (`_parallel.single_threaded_blas`), as subtrees are factored in parallel.

        Raises:
            ShapeError: the blocks do not match the pattern.
        """
        wanted = (len(self.pattern.row), int(self.pattern.size.max(initial=0)))
        if blocks.shape[0] != wanted[0] or blocks.shape[1] < wanted[1]:
            raise ShapeError(f"blocks must be {(*wanted, wanted[1])} or wider, got {blocks.shape}")
        nodes = self.supernodes
        panels, updates = np.empty(self.panel_size), np.empty(self.update_size)

        def factor(g: int) -> bool:
            return kernels.factor_supernodes(
                nodes, self.groups[g], blocks, panels, updates, np.zeros(4, np.int32)
            )

        done = all(_parallel.map_items(factor, len(self.groups) - 1)) and factor(len(self.groups) - 1)
        return BlockFactor(self, panels) if done else None


@dataclass(frozen=True, slots=True, eq=False)
class BlockFactor:
    """L of A = L L^T, in the elimination order of a plan."""

    plan: CholeskyPlan
    panels: Float64[np.ndarray, " e"]

    @checked
    def solve(self, rhs: Float64[np.ndarray, " s"]) -> Float64[np.ndarray, " s"]:
        """A^-1 rhs, with scalars in the order of the nodes."""
        scalars = _scalars(self.plan.pattern.size, self.plan.order)
        if len(rhs) != len(scalars):
            raise ShapeError(f"rhs must have {len(scalars)} rows, got {len(rhs)}")
        x = rhs[scalars]
        work = np.empty(int(self.plan.supernodes.num_rows.max(initial=1)))
        kernels.solve_supernodes(self.plan.supernodes, self.panels, x, np.zeros(4, np.int32), work)
        out = np.empty_like(x)
        out[scalars] = x
        return out

    def selected_inverse(self) -> Float64[np.ndarray, "b w w"]:
        """The blocks of A^-1 at the nonzero blocks of A (Takahashi, Fagan and Chin 1973), padded with zeros.

        From the last supernode to the first: with Y = L21 L11^-1 and Z the inverse over the rows of a front, known from its
        parent, the inverse is -Z Y beside the pivots and L11^-T L11^-1 + Y^T Z Y on them.
        """
        nodes, pattern = self.plan.supernodes, self.plan.pattern
        width = int(pattern.size.max(initial=1))
        out = np.zeros((len(pattern.row), width, width))
        fronts: dict[int, np.ndarray] = {}
        waiting = np.bincount(nodes.parent[nodes.parent >= 0], minlength=len(nodes.parent))
        for s in range(len(nodes.parent) - 1, -1, -1):
            m, k, parent = int(nodes.num_rows[s]), int(nodes.num_pivots[s]), int(nodes.parent[s])
            panel = self.panels[nodes.panel_start[s] : nodes.panel_start[s] + m * k].reshape(k, m).T
            inverse = solve_triangular(panel[:k], np.eye(k), lower=True, check_finite=False)
            front = np.empty((m, m))
            front[:k, :k] = inverse.T @ inverse
            if m > k:
                rows = self._rows_in_parent(s)
                front[k:, k:] = fronts[parent][np.ix_(rows, rows)]
                y = panel[k:] @ inverse
                front[k:, :k] = -front[k:, k:] @ y
                front[:k, k:] = front[k:, :k].T
                front[:k, :k] -= y.T @ front[k:, :k]
            if parent >= 0:
                waiting[parent] -= 1
                if waiting[parent] == 0:
                    del fronts[parent]
            if waiting[s]:
                fronts[s] = front
            for e in range(nodes.block_start[s], nodes.block_start[s + 1]):
                i, j = nodes.block_row[e], nodes.block_column[e]
                height, wide = nodes.block_height[e], nodes.block_width[e]
                found = front[i : i + height, j : j + wide]
                if nodes.block_transposed[e]:
                    out[nodes.block[e], :wide, :height] = found.T
                else:
                    out[nodes.block[e], :height, :wide] = found
        return out

    def _rows_in_parent(self, s: int) -> np.ndarray:
        nodes = self.plan.supernodes
        own = slice(nodes.row_start[s], nodes.row_start[s + 1])
        slot = nodes.row[own]
        sizes = nodes.scalar_of_slot[slot + 1] - nodes.scalar_of_slot[slot]
        return _ranges(nodes.row_in_parent[own], sizes)


@checked
def plan_cholesky(pattern: BlockPattern, last_mask: Bool[np.ndarray, " n"] | None = None) -> CholeskyPlan:
    """Choose a fill-reducing elimination order, and lay out the factor.

    Args:
        pattern: nonzero blocks of the matrix.
        last_mask: nodes coupled to most others, to be eliminated last.
    """
    n = len(pattern.size)
    if last_mask is not None and len(last_mask) != n:
        raise ShapeError(f"last_mask must have {n} rows, got {len(last_mask)}")
    last = np.zeros(n, bool) if last_mask is None else last_mask
    order = _fill_reducing_order(pattern, last)
    parent, order = _tree_in_postorder(pattern, order)
    size = pattern.size[order]
    start, neighbor = _neighbors(pattern, order)
    column_start, row = _structure(start, neighbor, parent)
    scalar_of_slot = np.concatenate([[0], np.cumsum(size)])
    counts = np.add.reduceat(np.append(size[row], 0), column_start[:-1]) * (np.diff(column_start) > 0)
    first, scratch = np.empty(n + 1, np.int64), np.empty((2, n), np.int64)
    num = kernels.merge_columns(parent, counts, size, first, *scratch)
    first = first[: num + 1].copy()
    nodes = _lay_out(first, parent, column_start, row, scalar_of_slot)
    nodes = _with_blocks(nodes, pattern, order)
    k, m = nodes.num_pivots.astype(float), nodes.num_rows.astype(float)
    work = k**3 / 3 + k * k * (m - k) + k * (m - k) ** 2
    groups = _independent_subtrees(nodes.parent, work)
    update_start, update_size = _stack_updates(nodes.parent, (nodes.num_rows - nodes.num_pivots) ** 2, groups)
    panel_start = np.concatenate([[0], np.cumsum(nodes.num_rows * nodes.num_pivots)])
    nodes = nodes._replace(panel_start=panel_start[:-1].astype(np.int64), update_start=update_start)
    return CholeskyPlan(pattern, order, nodes, groups, int(panel_start[-1]), update_size, float(work.sum()))


def _fill_reducing_order(pattern: BlockPattern, last: np.ndarray) -> np.ndarray:
    """Multiple minimum degree (Liu 1985) on the graph of the nodes, as computed by SuperLU."""
    free = np.flatnonzero(~last)
    off = (pattern.row != pattern.column) & ~last[pattern.row] & ~last[pattern.column]
    count = int(off.sum())
    if len(free) < 3 or count > _DENSE_FRACTION * len(free) * (len(free) - 1) / 2:
        return np.concatenate([free, np.flatnonzero(last)])
    rank = np.cumsum(~last) - 1
    rows, columns = rank[pattern.row[off]], rank[pattern.column[off]]
    degree = np.bincount(rows, minlength=len(free)) + np.bincount(columns, minlength=len(free))
    values = np.concatenate([np.full(2 * count, -1.0), degree + 1.0])
    diagonal = np.arange(len(free))
    at = (np.concatenate([rows, columns, diagonal]), np.concatenate([columns, rows, diagonal]))
    graph = sparse.csc_matrix((values, at), shape=(len(free), len(free)))
    found = splu(graph, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    slot = np.empty(len(free), np.int64)
    slot[found.perm_c] = np.arange(len(free))
    return np.concatenate([free[slot], np.flatnonzero(last)])


def _neighbors(pattern: BlockPattern, order: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each slot the earlier slots coupled to it, as CSR."""
    slot = np.empty(len(order), np.int64)
    slot[order] = np.arange(len(order))
    off = pattern.row != pattern.column
    a, b = slot[pattern.row[off]], slot[pattern.column[off]]
    late, early = np.maximum(a, b), np.minimum(a, b)
    by = np.lexsort((early, late))
    return np.searchsorted(late[by], np.arange(len(order) + 1)).astype(np.int64), early[by]


def _tree_in_postorder(pattern: BlockPattern, order: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    parent, scratch, post = np.empty((3, len(order)), np.int64)
    kernels.elimination_tree(*_neighbors(pattern, order), parent, scratch)
    kernels.postorder(parent, *np.empty((2, len(order)), np.int64), post)
    order = order[post]
    kernels.elimination_tree(*_neighbors(pattern, order), parent, scratch)
    return parent, order


def _structure(start: np.ndarray, neighbor: np.ndarray, parent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    n = len(parent)
    mark, fill = np.empty((2, n), np.int64)
    column_start = np.zeros(n + 1, np.int64)
    kernels.column_structure(start, neighbor, parent, mark, column_start, fill, np.empty(0, np.int64))
    column_start[1:] = np.cumsum(fill)
    row = np.empty(column_start[-1], np.int64)
    if len(row):
        kernels.column_structure(start, neighbor, parent, mark, column_start, fill, row)
    return column_start, row


def _lay_out(
    first: np.ndarray,
    parent: np.ndarray,
    column_start: np.ndarray,
    row: np.ndarray,
    scalar_of_slot: np.ndarray,
) -> kernels.Supernodes:
    num, size = len(first) - 1, np.diff(scalar_of_slot)
    supernode_of_slot = np.repeat(np.arange(num), np.diff(first))
    ends = first[1:] - 1  # the last pivot has the rows of the supernode
    counts = column_start[ends + 1] - column_start[ends]
    row_start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    rows = row[_ranges(column_start[ends], counts)]
    pivots = scalar_of_slot[first[1:]] - scalar_of_slot[first[:-1]]
    running = np.concatenate([[0], np.cumsum(size[rows])])
    offset = running[:-1] - np.repeat(running[row_start[:-1]], counts) + np.repeat(pivots, counts)
    above = np.where(parent[ends] >= 0, supernode_of_slot[parent[ends]], -1)
    first_child, next_child = np.full((2, num), -1, np.int64)
    for s in range(num - 1, -1, -1):
        if above[s] >= 0:
            next_child[s], first_child[above[s]] = first_child[above[s]], s
    none = np.empty(0, np.int64)
    nodes = kernels.Supernodes(
        first,
        row_start,
        rows,
        offset.astype(np.int64),
        np.empty(len(rows), np.int64),
        above.astype(np.int64),
        first_child,
        next_child,
        pivots,
        pivots + running[row_start[1:]] - running[row_start[:-1]],
        none,
        none,
        scalar_of_slot,
        none,
        none,
        none,
        none,
        none,
        none,
        np.empty(0, bool),
    )
    kernels.rows_in_parents(nodes, np.empty(len(size), np.int64))
    return nodes


def _with_blocks(nodes: kernels.Supernodes, pattern: BlockPattern, order: np.ndarray) -> kernels.Supernodes:
    """Add the position in its front of each block of the matrix."""
    slot = np.empty(len(order), np.int64)
    slot[order] = np.arange(len(order))
    a, b = slot[pattern.row], slot[pattern.column]
    later, earlier = np.maximum(a, b), np.minimum(a, b)
    supernode_of_slot = np.repeat(np.arange(len(nodes.parent)), np.diff(nodes.first))
    block_row = np.empty(len(a), np.int64)
    kernels.assign_blocks(nodes, supernode_of_slot, later, earlier, block_row)
    owner = supernode_of_slot[earlier]
    by = np.argsort(owner, kind="stable")
    size = np.diff(nodes.scalar_of_slot)
    column = nodes.scalar_of_slot[earlier] - nodes.scalar_of_slot[nodes.first[owner]]
    return nodes._replace(
        block_start=np.searchsorted(owner[by], np.arange(len(nodes.parent) + 1)).astype(np.int64),
        block=by,
        block_row=block_row[by],
        block_column=column[by],
        block_height=size[later[by]],
        block_width=size[earlier[by]],
        block_transposed=(a < b)[by],
    )


def _independent_subtrees(parent: np.ndarray, work: np.ndarray) -> tuple[np.ndarray, ...]:
    """Groups of supernodes: independent subtrees of similar work; the last group is all supernodes above them."""
    num = len(parent)
    if work.sum() < _MIN_PARALLEL_FLOPS:
        return (np.arange(num),)
    total, first = work.copy(), np.arange(num)
    children: dict[int, list[int]] = {}
    for s, p in enumerate(parent.tolist()):
        children.setdefault(p, []).append(s)
        if p >= 0:
            total[p] += total[s]
            first[p] = min(first[p], first[s])
    roots, above = list(children.get(-1, [])), np.zeros(num, bool)
    while heavy := [s for s in roots if total[s] > work.sum() / _TASKS and s in children]:
        above[heavy] = True
        roots = [s for s in roots if not above[s]] + [c for s in heavy for c in children[s]]
    # Light subtrees of one parent are grouped, as each group costs a call.
    groups: list[np.ndarray] = []
    weight = np.inf
    for s in sorted(roots):
        own = np.arange(first[s], s + 1)
        if weight + total[s] <= work.sum() / _TASKS:
            groups[-1], weight = np.concatenate([groups[-1], own]), weight + total[s]
        else:
            groups.append(own)
            weight = total[s]
    return (*groups, np.flatnonzero(above))


def _stack_updates(
    parent: np.ndarray, sizes: np.ndarray, groups: tuple[np.ndarray, ...]
) -> tuple[np.ndarray, int]:
    """Offset of each update while it waits for its parent, and the total length.

    A front reads its children's updates while it writes its own, so generations alternate between two stacks. Each group
    has its own two, as groups run in parallel. The last group, above all others, shares nothing.
    """
    depth = np.zeros(len(parent), np.int64)
    for s in range(len(parent) - 1, -1, -1):
        depth[s] = depth[parent[s]] + 1 if parent[s] >= 0 else 0
    start, end = np.zeros(len(parent), np.int64), 0
    for group in groups[:-1] if len(groups) > 1 else groups:
        height, peak = [0, 0], [0, 0]
        children_size = np.zeros(len(parent), np.int64)
        for s in group:
            own, other = depth[s] % 2, 1 - depth[s] % 2
            start[s] = height[own]
            height[own] += int(sizes[s])
            peak[own] = max(peak[own], height[own])
            height[other] -= int(children_size[s])
            if parent[s] >= 0:
                children_size[parent[s]] += sizes[s]
        start[group] += end + np.where(depth[group] % 2 == 0, 0, peak[0])
        end += sum(peak)
    if len(groups) > 1:
        above = groups[-1]
        start[above] = end + np.cumsum(sizes[above]) - sizes[above]
        end += int(sizes[above].sum())
    return start, end


def _scalars(size: np.ndarray, order: np.ndarray) -> np.ndarray:
    """The scalars of the nodes, in this order of nodes."""
    first = np.concatenate([[0], np.cumsum(size)])[:-1]
    return _ranges(first[order], size[order])


def _ranges(starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Concatenation of starts[i], starts[i] + 1, ... (counts[i] values) for all i."""
    ends = np.cumsum(counts)
    return np.repeat(starts - ends + counts, counts) + np.arange(ends[-1] if len(ends) else 0)
