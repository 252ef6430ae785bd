"""Sparse block Cholesky factorization: the multifrontal method (Duff and Reid 1983; Liu, SIAM Review 1992).

Nodes (poses, cameras, ...) are eliminated in a given order. Adjacent columns of equal structure form a supernode s with
k pivots and m >= k rows. Its front is assembled from the matrix and from the updates of its children, then
    F = [A11 .; A21 A22],   L11 = chol(A11),   L21 = A21 L11^-T,   U = A22 - L21 L21^T,
where U is passed to the parent. Panels [L11; L21] are (m, k), updates U (m - k, m - k), both column-major, lower.
"""

import ctypes
from typing import Any, NamedTuple

import numpy as np
from llvmlite import binding
from numba import types
from numba.extending import get_cython_function_address

from epipole._jit import kernel
from epipole._jit.mode import KernelMode, kernel_mode


def _linked(module: str, name: str, *arguments: types.Type) -> Any:
    """A SciPy BLAS or LAPACK routine, linked by name, so that kernels that call it can be cached on disk."""
    symbol, address = f"epipole_{name}", get_cython_function_address(f"scipy.linalg.{module}", name)
    if kernel_mode() is KernelMode.PYTHON:
        return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * len(arguments))(address)
    binding.add_symbol(symbol, address)
    return types.ExternalFunction(symbol, types.void(*arguments))


_CHAR, _INT, _REAL = types.CPointer(types.uint8), types.CPointer(types.int32), types.CPointer(types.float64)
_potrf = _linked("cython_lapack", "dpotrf", _CHAR, _INT, _REAL, _INT, _INT)
_trsm = _linked(
    "cython_blas", "dtrsm", _CHAR, _CHAR, _CHAR, _CHAR, _INT, _INT, _REAL, _REAL, _INT, _REAL, _INT
)
_syrk = _linked("cython_blas", "dsyrk", _CHAR, _CHAR, _INT, _INT, _REAL, _REAL, _INT, _REAL, _REAL, _INT)
_trsv = _linked("cython_blas", "dtrsv", _CHAR, _CHAR, _CHAR, _INT, _REAL, _INT, _REAL, _INT)
_gemv = _linked(
    "cython_blas", "dgemv", _CHAR, _INT, _INT, _REAL, _REAL, _INT, _REAL, _INT, _REAL, _REAL, _INT
)

_LOWER, _PLAIN, _TRANSPOSED, _RIGHT = (np.array([ord(c)], np.uint8) for c in "LNTR")
_ONE, _MINUS_ONE, _STEP = np.array([1.0]), np.array([-1.0]), np.array([1], np.int32)


class Supernodes(NamedTuple):
    """The symbolic factorization. Slots are positions in the elimination order."""

    first: np.ndarray
    """(supernodes + 1,), first slot of each; its pivots extend to the first slot of the next."""
    row_start: np.ndarray
    """(supernodes + 1,), start of its rows beyond the pivots."""
    row: np.ndarray
    """Slots of these rows."""
    row_offset: np.ndarray
    """For each row, its first scalar row in its own front."""
    row_in_parent: np.ndarray
    """For each row, its first scalar row in the parent's front."""
    parent: np.ndarray
    first_child: np.ndarray
    next_child: np.ndarray
    num_pivots: np.ndarray
    """Number of scalars."""
    num_rows: np.ndarray
    """Number of scalars, including pivots."""
    panel_start: np.ndarray
    update_start: np.ndarray
    scalar_of_slot: np.ndarray
    """(slots + 1,), first scalar of each slot."""
    block_start: np.ndarray
    """(supernodes + 1,), start of each supernode's matrix blocks."""
    block: np.ndarray
    """Index of the matrix block."""
    block_row: np.ndarray
    """Its first scalar row in the front."""
    block_column: np.ndarray
    """Its first scalar column in the front."""
    block_height: np.ndarray
    block_width: np.ndarray
    block_transposed: np.ndarray
    """Whether the matrix stores its transpose."""


@kernel
def elimination_tree(start, neighbor, parent, ancestor):
    """Parent of each column (Liu 1986); `neighbor` lists slots, of which only smaller ones count."""
    for i in range(len(parent)):
        parent[i] = ancestor[i] = -1
        for e in range(start[i], start[i + 1]):
            j = neighbor[e]
            while j != -1 and j < i:
                following = ancestor[j]
                ancestor[j] = i
                if following == -1:
                    parent[j] = i
                j = following


@kernel
def postorder(parent, first_child, next_child, order):
    """Postorder of the columns, each right after its subtree; first_child and next_child are scratch."""
    n = len(parent)
    for i in range(n):
        first_child[i] = next_child[i] = -1
    for i in range(n - 1, -1, -1):
        if parent[i] >= 0:
            next_child[i] = first_child[parent[i]]
            first_child[parent[i]] = i
    count = 0
    for root in range(n):
        if parent[root] >= 0:
            continue
        node = root
        while True:
            while first_child[node] >= 0:  # descend to a leaf, removing each child from its parent's list
                child = first_child[node]
                first_child[node] = next_child[child]
                node = child
            order[count] = node
            count += 1
            if node == root:
                break
            node = parent[node]


@kernel
def column_structure(start, neighbor, parent, mark, column_start, fill, row):
    """Row counts (`fill`, if `row` is empty) or the rows below each column's diagonal, ascending."""
    counting = len(row) == 0
    n = len(parent)
    for j in range(n):
        fill[j] = 0
        mark[j] = -1
    for i in range(n):
        mark[i] = i
        for e in range(start[i], start[i + 1]):
            j = neighbor[e]
            while j < i and mark[j] != i:
                if not counting:
                    row[column_start[j] + fill[j]] = i
                fill[j] += 1
                mark[j] = i
                j = parent[j]


@kernel
def merge_columns(parent, count, size, first, pivots, entries):
    """Merge columns into supernodes: first slots into `first`; returns their number.

    A supernode is merged into its parent, if that is the next one, unless this stores many zeros (Ashcraft and Grimes 1989;
    thresholds from CHOLMOD). `pivots` and `entries` are scratch: scalar columns and true entries.
    """
    top = 0
    for j in range(len(parent)):
        below = count[j]  # scalar rows below the diagonal block
        k, true = size[j], size[j] * (size[j] + 1) // 2 + size[j] * below
        start = j
        while top > 0 and 0 <= parent[start - 1] <= j:
            joined = pivots[top - 1] + k
            stored = joined * (joined + 1) // 2 + joined * below
            zeros = stored - true - entries[top - 1]
            fraction = 0.05 if joined > 192 else (0.1 if joined > 64 else 0.8)
            if joined > 24 and zeros > fraction * stored:
                break
            k, true = joined, true + entries[top - 1]
            top -= 1
            start = first[top]
        first[top], pivots[top], entries[top] = start, k, true
        top += 1
    first[top] = len(parent)
    return top


@kernel
def rows_in_parents(nodes, where):
    """Fill row_in_parent; `where` is scratch, one entry per slot."""
    for p in range(len(nodes.parent)):
        offset = 0
        for slot in range(nodes.first[p], nodes.first[p + 1]):
            where[slot] = offset
            offset += nodes.scalar_of_slot[slot + 1] - nodes.scalar_of_slot[slot]
        for e in range(nodes.row_start[p], nodes.row_start[p + 1]):
            where[nodes.row[e]] = nodes.row_offset[e]
        child = nodes.first_child[p]
        while child >= 0:
            for e in range(nodes.row_start[child], nodes.row_start[child + 1]):
                nodes.row_in_parent[e] = where[nodes.row[e]]
            child = nodes.next_child[child]


@kernel
def assign_blocks(nodes, supernode_of_slot, later, earlier, row_of_block):
    """The first scalar row of each matrix block in its front, from its later and earlier slot."""
    for b in range(len(later)):
        s, slot = supernode_of_slot[earlier[b]], later[b]
        if slot < nodes.first[s + 1]:
            row_of_block[b] = nodes.scalar_of_slot[slot] - nodes.scalar_of_slot[nodes.first[s]]
            continue
        low, high = nodes.row_start[s], nodes.row_start[s + 1]
        while high - low > 1:
            middle = (low + high) // 2
            if nodes.row[middle] <= slot:
                low = middle
            else:
                high = middle
        row_of_block[b] = nodes.row_offset[low]


@kernel
def _assemble(nodes, s, blocks, panels, updates):
    """Sum the front of supernode s: its own blocks, and its children's updates."""
    m, k = nodes.num_rows[s], nodes.num_pivots[s]
    r = m - k
    panel, update = nodes.panel_start[s], nodes.update_start[s]
    for e in range(panel, panel + m * k):
        panels[e] = 0.0
    for e in range(update, update + r * r):
        updates[e] = 0.0
    for e in range(nodes.block_start[s], nodes.block_start[s + 1]):
        b, at = nodes.block[e], panel + nodes.block_row[e] + m * nodes.block_column[e]
        for j in range(nodes.block_width[e]):
            for i in range(nodes.block_height[e]):
                panels[at + i + m * j] += blocks[b, j, i] if nodes.block_transposed[e] else blocks[b, i, j]
    child = nodes.first_child[s]
    while child >= 0:
        _extend_add(nodes, child, m, k, panel, update, panels, updates)
        child = nodes.next_child[child]


@kernel
def _extend_add(nodes, child, m, k, panel, update, panels, updates):
    """Add the child's update to the front (m rows, k pivots) at `panel` and `update`."""
    height = nodes.num_rows[child] - nodes.num_pivots[child]
    start, end, base = nodes.row_start[child], nodes.row_start[child + 1], nodes.num_pivots[child]
    r = m - k
    for e in range(start, end):
        first = nodes.row_offset[e] - base
        width = (nodes.row_offset[e + 1] - base if e + 1 < end else height) - first
        for j in range(width):
            column = nodes.row_in_parent[e] + j
            source = nodes.update_start[child] + (first + j) * height
            if column < k:
                target = panel + column * m
                shift = 0
                for f in range(e, end):
                    low = nodes.row_offset[f] - base
                    high = nodes.row_offset[f + 1] - base if f + 1 < end else height
                    shift = nodes.row_in_parent[f] - low
                    for i in range(low, high):
                        panels[target + shift + i] += updates[source + i]
            else:
                target = update + (column - k) * r
                for f in range(e, end):
                    low = nodes.row_offset[f] - base
                    high = nodes.row_offset[f + 1] - base if f + 1 < end else height
                    shift = nodes.row_in_parent[f] - low - k
                    for i in range(low, high):
                        updates[target + shift + i] += updates[source + i]


@kernel
def factor_supernodes(nodes, chosen, blocks, panels, updates, dims):
    """Factor the chosen supernodes, children before parents; False if the matrix is not positive definite.

    `dims` is scratch, four 32-bit integers, as BLAS takes numbers by address.
    """
    for s in chosen:
        _assemble(nodes, s, blocks, panels, updates)
        m, k = nodes.num_rows[s], nodes.num_pivots[s]
        dims[0], dims[1], dims[2] = m, k, m - k
        panel, update = nodes.panel_start[s], nodes.update_start[s]
        corner = panels[panel:]
        _potrf(_LOWER.ctypes, dims[1:].ctypes, corner.ctypes, dims.ctypes, dims[3:].ctypes)
        if dims[3] != 0:
            return False
        if m == k:
            continue
        below, rest = panels[panel + k :], updates[update:]
        _trsm(
            _RIGHT.ctypes,
            _LOWER.ctypes,
            _TRANSPOSED.ctypes,
            _PLAIN.ctypes,
            dims[2:].ctypes,
            dims[1:].ctypes,
            _ONE.ctypes,
            corner.ctypes,
            dims.ctypes,
            below.ctypes,
            dims.ctypes,
        )
        _syrk(
            _LOWER.ctypes,
            _PLAIN.ctypes,
            dims[2:].ctypes,
            dims[1:].ctypes,
            _MINUS_ONE.ctypes,
            below.ctypes,
            dims.ctypes,
            _ONE.ctypes,
            rest.ctypes,
            dims[2:].ctypes,
        )
    return True


@kernel
def solve_supernodes(nodes, panels, x, dims, work):
    """Replace x, in elimination order, by (L L^T)^-1 x; dims as in `factor_supernodes`, work for one front's rows."""
    count = len(nodes.parent)
    for step in range(2 * count):
        forward = step < count
        s = step if forward else 2 * count - 1 - step
        m, k = nodes.num_rows[s], nodes.num_pivots[s]
        dims[0], dims[1], dims[2] = m, k, m - k
        start = nodes.scalar_of_slot[nodes.first[s]]
        corner, below, own = panels[nodes.panel_start[s] :], panels[nodes.panel_start[s] + k :], x[start:]
        transposed = _PLAIN if forward else _TRANSPOSED
        for e in range(nodes.row_start[s], nodes.row_start[s + 1]):
            slot = nodes.row[e]
            source, at = nodes.scalar_of_slot[slot], nodes.row_offset[e] - k
            for i in range(nodes.scalar_of_slot[slot + 1] - source):
                work[at + i] = 0.0 if forward else x[source + i]
        if forward:
            _trsv(
                _LOWER.ctypes,
                transposed.ctypes,
                _PLAIN.ctypes,
                dims[1:].ctypes,
                corner.ctypes,
                dims.ctypes,
                own.ctypes,
                _STEP.ctypes,
            )
        if m > k:
            source, target = (own, work) if forward else (work, own)
            _gemv(
                transposed.ctypes,
                dims[2:].ctypes,
                dims[1:].ctypes,
                _MINUS_ONE.ctypes,
                below.ctypes,
                dims.ctypes,
                source.ctypes,
                _STEP.ctypes,
                _ONE.ctypes,
                target.ctypes,
                _STEP.ctypes,
            )
        if not forward:
            _trsv(
                _LOWER.ctypes,
                transposed.ctypes,
                _PLAIN.ctypes,
                dims[1:].ctypes,
                corner.ctypes,
                dims.ctypes,
                own.ctypes,
                _STEP.ctypes,
            )
            continue
        for e in range(nodes.row_start[s], nodes.row_start[s + 1]):
            slot = nodes.row[e]
            target_at, at = nodes.scalar_of_slot[slot], nodes.row_offset[e] - k
            for i in range(nodes.scalar_of_slot[slot + 1] - target_at):
                x[target_at + i] += work[at + i]
