"""The normal equations of bundle adjustment without the points: formed and factored, or solved iteratively.

Damping is Marquardt's: a fraction of V's diagonal for points, of the Schur complement's diagonal otherwise. Both scale
with the problem, whatever its units, so a focal length of 1e10 and an angle can be mixed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

import numpy as np

from epipole import _parallel
from epipole.errors import DegenerateGeometryError
from epipole.optim import _bundle_arrays as arrays
from epipole.optim import _bundle_kernels as kernels
from epipole.optim import _bundle_layout_kernels as layout_kernels
from epipole.optim import _bundle_reduced_kernels as reduced_kernels
from epipole.optim.block_cholesky import BlockPattern, CholeskyPlan, plan_cholesky
from epipole.optim.bundle_layout import BundleLayout, BundleState, lay_out, reduced_pattern
from epipole.optim.bundle_priors import PriorTerms, prior_terms
from epipole.optim.bundle_problem import BundleProblem
from epipole.optim.losses import Loss

_LEAST_CURVATURE = 1e-9
"""A column is damped as if at least this fraction of its curvature were left after elimination."""
_ROW_PIECES, _ROWS_AT_ONCE = 32, 16
"""Pieces of the reduced matrix, and rows that are summed together: their blocks fit the cache, and Z is read once for them."""
_FLOPS_PER_S, _BYTES_PER_S, _PAIR_S = 2e10, 6e9, 1.5e-8
_USUAL_PRODUCTS = 40
_MAX_DIRECT_BYTES = 6 << 30


class LinearSolver(StrEnum):
    """Linear solver of each step."""

    AUTO = "auto"
    """Whichever is expected to be faster and fits into memory."""
    DIRECT = "direct"
    """Sparse Cholesky factorization of the Schur complement; dense if all cameras are coupled."""
    ITERATIVE = "iterative"
    """Conjugate gradients on the Schur complement, without forming it; block-diagonal preconditioner."""


@dataclass(frozen=True, slots=True, eq=False)
class Linearization:
    """The normal equations at a state and a damping, with the points eliminated."""

    gradient: np.ndarray
    """J^T r of the nodes (nodes, lanes)."""
    rhs: np.ndarray
    """Right-hand side for the step of the nodes: S step = rhs."""
    blocks: np.ndarray
    """The lower triangle of S by blocks if it was formed; otherwise only its part that does not come from points."""
    corner: np.ndarray
    """The diagonal blocks of S (nodes, lanes, lanes), without damping."""
    damping: np.ndarray
    """Added to S's diagonal (nodes, lanes), included in `blocks`."""


class BundleSystem:
    """The linear algebra of one problem; keeps constant parts and working arrays between steps."""

    def __init__(
        self,
        problem: BundleProblem,
        loss: Loss,
        loss_scale_px: float,
        solver: LinearSolver,
        *,
        single_precision: bool,
    ) -> None:
        self.problem = problem
        self.layout: BundleLayout = lay_out(problem)
        self._loss = (int(loss), float(loss_scale_px**2))
        entries, num_points = self.layout.entries, len(problem.points_in_world)
        self.kept = arrays.Eliminated(
            arrays.rows_of_zeros(
                (len(entries.node), 3, len(self.layout.lanes)), np.float32 if single_precision else np.float64
            ),
            np.empty((num_points, 6)),
            np.empty((num_points, 3)),
        )
        self.pattern: BlockPattern
        self.plan: CholeskyPlan | None = None
        self._choose_solver(LinearSolver(solver))
        n = self.layout.num_nodes
        self.row_start = np.searchsorted(self.pattern.row, np.arange(n + 1)).astype(np.int64)
        self._diagonal = np.flatnonzero(self.pattern.row == self.pattern.column)
        self._positions = self._poses_of_images()
        work = np.zeros(n, np.int64)
        layout_kernels.count_pairs(entries.start, entries.node, work)
        fractions = np.cumsum(work) / max(work.sum(), 1)
        self._pieces = np.unique(
            np.searchsorted(fractions, np.arange(1, _ROW_PIECES) / _ROW_PIECES, side="right")
        )

    @property
    def has_unknowns(self) -> bool:
        """Whether anything is free."""
        return self.layout.num_nodes > 0 or bool((self.layout.unknowns.role != arrays.FIXED).any())

    @property
    def solver(self) -> LinearSolver:
        """The chosen solver."""
        return LinearSolver.ITERATIVE if self.plan is None else LinearSolver.DIRECT

    def _choose_solver(self, requested: LinearSolver) -> None:
        entries, width = self.layout.entries, len(self.layout.lanes)
        pairs = int(
            layout_kernels.count_pairs(entries.start, entries.node, np.zeros(self.layout.num_nodes, np.int64))
        )
        iterative_s = _USUAL_PRODUCTS * self.kept.z.nbytes / _BYTES_PER_S
        if requested is not LinearSolver.ITERATIVE and (
            requested is LinearSolver.DIRECT or pairs * _PAIR_S / 2 < 2 * iterative_s + 1
        ):
            self.pattern = reduced_pattern(self.layout, self.problem, with_points=True)
            last = np.arange(self.layout.num_nodes) < self.layout.num_border
            plan = plan_cholesky(self.pattern, last)
            direct_s = pairs * _PAIR_S / 2 + plan.flops / _FLOPS_PER_S
            num_bytes = 8 * (plan.panel_size + plan.update_size + len(self.pattern.row) * width**2)
            if requested is LinearSolver.DIRECT or (
                direct_s < iterative_s + 0.1 and num_bytes < _MAX_DIRECT_BYTES
            ):
                self.plan = plan
                return
        self.pattern = reduced_pattern(self.layout, self.problem, with_points=False)

    def _poses_of_images(self) -> np.ndarray:
        """(images, 3, 3): block index for each pair of an image's nodes in the lower triangle, else -1."""
        n, nodes = max(self.layout.num_nodes, 1), self.layout.unknowns.nodes
        key = self.pattern.row * n + self.pattern.column
        a, b = nodes[:, :, None], nodes[:, None, :]
        wanted = a * n + b
        at = np.minimum(np.searchsorted(key, wanted), max(len(key) - 1, 0))
        found = (a >= b) & (b >= 0)
        return np.where(found, at, -1).astype(np.int64)

    def cost(self, state: BundleState) -> float:
        """Half the robust sum of squares, including priors."""
        layout, scene = self.layout, self.layout.scene(state)
        parts = _parallel.map_chunks(
            lambda a, b, _: kernels.total_cost(layout.observations, a, b, scene, *self._loss),
            len(state.points),
            layout.num_chunks,
        )
        return float(sum(parts)) + prior_terms(self.problem.priors, layout, state).cost

    def improve(self, state: BundleState, before: BundleState) -> float:
        """Refine each point with the cameras of the state fixed; returns the cost."""
        layout, scene = self.layout, self.layout.scene(state)
        role = layout.unknowns.role
        parts = _parallel.map_chunks(
            lambda a, b, _: kernels.damp_points(
                layout.observations, a, b, scene, role, *self._loss, before.points, self._scratch()
            ),
            len(state.points),
            layout.num_chunks,
        )
        return float(sum(parts)) + prior_terms(self.problem.priors, layout, state).cost

    def find_visible(self, state: BundleState) -> np.ndarray:
        """Exclude observations without a finite residual at this state; returns the mask of used ones."""
        layout, scene = self.layout, self.layout.scene(state)
        _parallel.map_chunks(
            lambda a, b, _: kernels.find_visible(layout.observations, a, b, scene),
            len(state.points),
            layout.num_chunks,
        )
        return layout.observations.used

    def linearize(self, state: BundleState, damping: float) -> Linearization:
        """Form the normal equations and eliminate the points."""
        layout = self.layout
        normal, image_gradient, reduced = self._sum_over_points(state, damping)
        blocks = arrays.rows_of_zeros((len(self.pattern.row), len(layout.lanes), len(layout.lanes)))
        gradient = arrays.rows_of_zeros((layout.num_nodes, len(layout.lanes)))
        reduced_kernels.add_images(
            layout.unknowns, normal, image_gradient, self._positions, blocks, gradient, layout.wide
        )
        self._add_priors(prior_terms(self.problem.priors, layout, state), blocks, gradient)
        self._move_kept_points(blocks, gradient)
        corner = blocks[self._diagonal]
        curvature = np.einsum("nii->ni", corner).copy()
        if self.plan is not None:
            self._subtract_eliminated(self.row_start, self.pattern.column, blocks)
            corner = blocks[self._diagonal]
        else:
            n = np.arange(layout.num_nodes + 1)
            self._subtract_eliminated(n, n[:-1], corner)
        left = np.einsum("nii->ni", corner)
        damp = damping * np.maximum(left, _LEAST_CURVATURE * curvature) + 1e-300
        damp[layout.fixed_mask] = 1.0
        damp[np.arange(len(layout.lanes)) >= layout.entries.width[:, None]] = 0.0
        blocks[self._diagonal[:, None], np.arange(len(layout.lanes)), np.arange(len(layout.lanes))] += damp
        return Linearization(gradient, reduced - gradient, blocks, corner, damp)

    def _scratch(self) -> arrays.Scratch:
        return kernels.make_scratch(len(self.layout.wide))

    def _sum_over_points(
        self, state: BundleState, damping: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        layout, scene = self.layout, self.layout.scene(state)
        images, wide = len(layout.images.frame), len(layout.wide)

        def work(start: int, stop: int, _: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            sums = (
                arrays.rows_of_zeros((images, wide, wide)),
                arrays.rows_of_zeros((images, wide)),
                arrays.rows_of_zeros((layout.num_nodes, len(layout.lanes))),
            )
            points = layout.observations, start, stop, scene, layout.unknowns, layout.entries
            outputs = self.kept, sums, layout.lanes, layout.wide, self._scratch()
            kernels.linearize(*points, *self._loss, damping, *outputs)
            return sums

        parts = _parallel.map_chunks(work, len(state.points), layout.num_chunks)
        if not parts:
            return work(0, 0, 0)
        for other in parts[1:]:
            for total, part in zip(parts[0], other, strict=True):
                total += part
        return parts[0]

    def _subtract_eliminated(self, row_start: np.ndarray, column: np.ndarray, blocks: np.ndarray) -> None:
        """Subtract Z Z^T from the blocks, in chunks of rows with similar work."""
        inner: list[int] = [] if self.layout.num_chunks == 1 else self._pieces.tolist()
        ranges = list(pairwise([0, *inner, self.layout.num_nodes]))

        def reduce(piece: int) -> None:
            slot = np.full((_ROWS_AT_ONCE, self.layout.num_nodes), -1, np.int64)
            rows = *ranges[piece], self.layout.entries, self.kept.z, row_start, column
            reduced_kernels.reduce_rows(*rows, blocks, slot, self.layout.lanes)

        _parallel.map_items(reduce, len(ranges))

    def _add_priors(self, terms: PriorTerms, blocks: np.ndarray, gradient: np.ndarray) -> None:
        gradient += terms.gradient
        blocks[self._diagonal] += terms.diagonal
        n = self.layout.num_nodes
        for row, column, block in terms.pairs:
            at = np.searchsorted(self.pattern.row * n + self.pattern.column, row * n + column)
            lanes = np.arange(block.shape[1])
            np.add.at(blocks, (at[:, None, None], lanes[:, None], lanes), block)

    def _move_kept_points(self, blocks: np.ndarray, gradient: np.ndarray) -> None:
        """Turn V, W and g_p of points that are not eliminated, left by `linearize`, into blocks of the system."""
        layout, entries = self.layout, self.layout.entries
        n = layout.num_nodes
        key = self.pattern.row * n + self.pattern.column
        for j in np.flatnonzero(layout.nodes.point >= 0):
            own = int(layout.nodes.point[j])
            v0, v1, v2, v3, v4, v5 = self.kept.factor[j]
            blocks[self._diagonal[own], :3, :3] += [[v0, v1, v2], [v1, v3, v4], [v2, v4, v5]]
            gradient[own, :3] += self.kept.h[j]
            for e in range(entries.start[j], entries.start[j + 1]):
                node = int(entries.node[e])
                at = np.searchsorted(key, max(own, node) * n + min(own, node))
                width = entries.width[node]
                w = self.kept.z[e, :, :width]
                if node > own:
                    blocks[at, :width, :3] += w.T
                else:
                    blocks[at, :3, :width] += w
                self.kept.z[e] = 0.0
            self.kept.factor[j] = 0.0
            self.kept.h[j] = 0.0

    def solve(self, system: Linearization) -> tuple[np.ndarray | None, int]:
        """Step of the nodes (nodes, lanes), None if the matrix is not positive definite; number of products."""
        layout = self.layout
        if layout.num_nodes == 0:
            return np.zeros((0, len(layout.lanes))), 0
        mask = np.arange(len(layout.lanes)) < layout.entries.width[:, None]
        if self.plan is None:
            step, products = self._iterate(system)
        else:
            factor, products = self.plan.factorize(system.blocks), 0
            if factor is None:
                return None, 0
            step = np.zeros(mask.shape)
            step[mask] = factor.solve(system.rhs[mask])
        step[layout.fixed_mask] = 0.0
        return (step if np.isfinite(step).all() else None), products

    def inverse_blocks(self, system: Linearization) -> np.ndarray:
        """The blocks of S^-1 at the nonzero blocks of S.

        Raises:
            DegenerateGeometryError: S is not positive definite.
        """
        lanes = len(self.layout.lanes)
        if self.plan is None or self.layout.num_nodes == 0:
            return np.zeros((0, lanes, lanes))
        factor = self.plan.factorize(system.blocks)
        if factor is None:
            raise DegenerateGeometryError(
                "the normal equations are not positive definite, so the problem is underdetermined"
            )
        out = np.zeros((len(self.pattern.row), lanes, lanes))
        found = factor.selected_inverse()
        out[:, : found.shape[1], : found.shape[2]] = found
        return out

    def _iterate(self, system: Linearization) -> tuple[np.ndarray, int]:
        inverse = system.corner.copy()
        lanes = np.arange(len(self.layout.lanes))
        inverse[:, lanes, lanes] += system.damping + (lanes >= self.layout.entries.width[:, None])
        inverse[:] = np.linalg.inv(inverse)
        return conjugate_gradients(
            lambda x: self.product(system, x), lambda r: (inverse @ r[..., None])[..., 0], system.rhs
        )

    def product(self, system: Linearization, x: np.ndarray) -> np.ndarray:
        """S x without S."""
        row, column = self.pattern.row, self.pattern.column
        out = np.zeros_like(x)
        np.add.at(out, row, (system.blocks @ x[column, :, None])[..., 0])
        off = row != column
        np.add.at(out, column[off], (np.swapaxes(system.blocks[off], 1, 2) @ x[row[off], :, None])[..., 0])

        def work(start: int, stop: int, _: int) -> np.ndarray:
            part = np.zeros_like(x)
            lanes = self.layout.lanes
            sums = arrays.rows_of_zeros((3, len(lanes)))
            reduced_kernels.multiply_eliminated(
                self.layout.entries, start, stop, self.kept.z, x, part, sums, lanes
            )
            return part

        for part in _parallel.map_chunks(work, len(self.problem.points_in_world), self.layout.num_chunks):
            out -= part
        return out

    def substitute_back(
        self, state: BundleState, system: Linearization, step: np.ndarray, damping: float
    ) -> tuple[BundleState, float]:
        """The state after the step of the nodes, including points, and the predicted decrease."""
        layout = self.layout
        moved = layout.moved(state, step)
        parts = _parallel.map_chunks(
            lambda a, b, _: reduced_kernels.substitute_back(
                layout.entries,
                a,
                b,
                state.points,
                self.kept,
                step,
                damping,
                moved.points,
                arrays.rows_of_zeros((3, len(layout.lanes))),
                layout.lanes,
            ),
            len(state.points),
            layout.num_chunks,
        )
        kept = np.flatnonzero(layout.nodes.point >= 0)
        moved.points[kept] += step[layout.nodes.point[kept], :3]
        nodes = 0.5 * float((step * (system.damping * step - system.gradient)).sum())
        return moved, float(sum(parts)) + nodes


def conjugate_gradients(
    multiply: Callable[[np.ndarray], np.ndarray],
    precondition: Callable[[np.ndarray], np.ndarray],
    rhs: np.ndarray,
    *,
    forcing: float = 0.1,
    max_products: int = 300,
) -> tuple[np.ndarray, int]:
    """Preconditioned conjugate gradients (Hestenes and Stiefel 1952), stopped when progress slows.

    Each iteration decreases the quadratic model by r^T z alpha / 2; it stops when this is less than `forcing` times the mean
    decrease so far (Nash and Sofer 1990).
    """
    x, r = np.zeros_like(rhs), rhs.copy()
    z = precondition(r)
    p, rz, fallen = z.copy(), float((r * z).sum()), 0.0
    for count in range(1, max_products + 1):
        if rz <= 0.0:
            return x, count - 1
        ap = multiply(p)
        curvature = float((p * ap).sum())
        if not curvature > 0.0:
            return x, count
        alpha = rz / curvature
        x += alpha * p
        r -= alpha * ap
        gain = 0.5 * alpha * rz
        fallen += gain
        if count * gain <= forcing * fallen:
            return x, count
        z = precondition(r)
        rz, before = float((r * z).sum()), rz
        p = z + (rz / before) * p
    return x, max_products
