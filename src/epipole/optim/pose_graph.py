"""Pose graph optimization from redundant relative motions.

Residual of edge k from i to j with the measurement z = i_from_j: r = log(z^-1 (x_i^-1 x_j)), x = world_from_body. Steps are
applied from the right, x exp(delta). The cost is half the sum of r^T Omega r (Grisetti, Kuemmerle, Stachniss and Burgard,
IEEE ITS Magazine 2010).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float64, Int64
from scipy.sparse.linalg import splu

from epipole import _parallel
from epipole._checks import check_fields, check_options, checked
from epipole.config import options_of
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid2, Rigid3, Rotation3, Similarity3
from epipole.geometry.tangents import inverse_right_jacobian
from epipole.optim.block_cholesky import BlockPattern, plan_cholesky

Motion = Rigid2 | Rigid3 | Similarity3


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraph:
    """Poses and measured relative motions, all of one type: Rigid2, Rigid3 or Similarity3."""

    world_from_body: Motion
    """Batch (n,), initial poses."""
    first: Int64[np.ndarray, " m"]
    second: Int64[np.ndarray, " m"]
    first_from_second: Motion
    """Batch (m,), measured."""
    information: Float64[np.ndarray, "m d d"]
    """Inverse covariances in the tangent (translation, rotation[, log scale])."""
    fixed: Int64[np.ndarray, " f"] = field(default_factory=lambda: np.empty(0, np.int64))
    """Constant poses. A connected component without one fixes its first pose."""

    def __post_init__(self) -> None:
        """Check the arrays.

        Raises:
            ShapeError: an index is out of range, or shapes differ.
        """
        check_fields(self)
        self._check_numbers()
        n, m, d = len(self.world_from_body.translation), len(self.first), self.dimension
        if type(self.world_from_body) is not type(self.first_from_second):
            raise ShapeError("world_from_body and first_from_second must be of one type")
        if not len(self.second) == len(self.first_from_second.translation) == m:
            raise ShapeError("first, second and first_from_second must have the same length")
        if self.information.shape != (m, d, d):
            raise ShapeError(f"information must be ({m}, {d}, {d}), got {self.information.shape}")
        if m and not (
            min(self.first.min(), self.second.min()) >= 0 and max(self.first.max(), self.second.max()) < n
        ):
            raise ShapeError(f"an edge refers to a pose that does not exist (there are {n})")
        if len(self.fixed) and not 0 <= self.fixed.min() <= self.fixed.max() < n:
            raise ShapeError(f"fixed refers to a pose that does not exist (there are {n})")

    def _check_numbers(self) -> None:
        """Check that all numbers are finite, as others would spread over the graph."""
        for owner in ("world_from_body", "first_from_second"):
            motions = getattr(self, owner)
            if len(motions.batch_shape()) != 1:
                raise ShapeError(f"{owner} must have a batch of one axis, got {motions.batch_shape()}")
            for name in motions.__slots__:
                if not np.isfinite(getattr(motions, name)).all():
                    raise ShapeError(f"{owner}.{name} must be finite")
            if isinstance(motions, Similarity3) and not (motions.scale > 0).all():
                raise ShapeError(f"{owner}.scale must be positive")
        if not np.isfinite(self.information).all():
            raise ShapeError("information must be finite")

    @property
    def dimension(self) -> int:
        """Size of a step per pose: 3, 6 or 7."""
        return {Rigid2: 3, Rigid3: 6, Similarity3: 7}[type(self.world_from_body)]

    def __len__(self) -> int:
        return len(self.world_from_body.translation)

    def __repr__(self) -> str:
        return f"PoseGraph({len(self.world_from_body)} bodies, {len(self.first)} motions between them)"


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseGraphConfig:
    """Options of pose graph optimization."""

    max_iterations: int = 100
    relative_tolerance: float = 1e-7
    """Stop when a step lowers the cost by a smaller fraction."""
    confidence: float = 0.99
    """Robust only: an edge is an inlier if its residual lies within this quantile of the chi-square distribution."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        check_options(self)
        if self.max_iterations < 1 or not self.relative_tolerance >= 0:
            raise ConfigError("max_iterations must be at least 1 and relative_tolerance not negative")
        if not 1e-9 < self.confidence < 1:  # any lower, and no residual would be an inlier
            raise ConfigError(f"confidence must be between 0 and 1, got {self.confidence}")


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraphResult:
    """The optimized poses, and the residual of each edge."""

    world_from_body: Motion
    initial_cost: float
    final_cost: float
    """Over the edges that were kept."""
    num_iterations: int
    converged: bool
    kept_mask: Bool[np.ndarray, " m"]
    """False for edges rejected by robust optimization."""
    squared_residuals: Float64[np.ndarray, " m"]
    """r^T Omega r of every edge, including rejected ones."""

    def __repr__(self) -> str:
        kept = f"{int(self.kept_mask.sum())} of {len(self.kept_mask)} edges"
        return f"PoseGraphResult(cost {self.initial_cost:.6g} -> {self.final_cost:.6g}, {kept})"


@checked
def pose_graph_cost(graph: PoseGraph) -> float:
    """Half the sum of r^T Omega r."""
    return 0.5 * float(_squared(graph, _residuals(graph, graph.world_from_body)[1]).sum())


@checked
def optimize_pose_graph(
    graph: PoseGraph,
    config: PoseGraphConfig | None = None,
    progress: Callable[[int, float], bool] | None = None,
) -> PoseGraphResult:
    """Levenberg-Marquardt with sparse factorization; fixes the given poses, or the first one of a connected component.

    Args:
        graph: poses and edges.
        config: options.
        progress: called with (iteration, cost) after every step; the optimization stops if it returns False.

    Raises:
        DegenerateGeometryError: an information matrix is not positive definite.
    """
    with _parallel.single_threaded_blas():
        return optimize_weighted(
            graph, options_of(PoseGraphConfig, config), np.ones(len(graph.first)), progress
        )


@checked
def initialize_pose_graph(graph: PoseGraph) -> PoseGraph:
    """Initial poses from the edges alone: chordal relaxation of the rotations, then linear translations.

    Rotations minimize sum |R_i Z - R_j|^2 over free matrices, then become the nearest rotations (Martinec and Pajdla, CVPR
    2007; Carlone et al., ICRA 2015). Fixes the given poses, or the first one of a connected component.

    Raises:
        ShapeError: the poses are similarities.
    """
    if isinstance(graph.world_from_body, Similarity3):
        raise ShapeError("chordal initialization does not support Similarity3")
    if isinstance(graph.world_from_body, Rigid2):
        start, measured = graph.world_from_body.as_rigid3(), graph.first_from_second.as_rigid3()  # type: ignore[union-attr]
    else:
        start, measured = graph.world_from_body, graph.first_from_second
    n, m = len(graph), len(graph.first)
    fixed = _anchors(graph)
    free = np.setdiff1d(np.arange(n), fixed)
    rows = np.arange(3 * m).reshape(m, 3)
    # (R_i Z - R_j)^T = Z^T R_i^T - R_j^T: three right-hand sides share one matrix.
    values = np.concatenate([np.swapaxes(measured.rotation, 1, 2).ravel(), np.tile(-np.eye(3).ravel(), m)])
    at = np.concatenate([_block_rows(rows), _block_rows(rows)])
    where = np.concatenate([_block_columns(graph.first, 3), _block_columns(graph.second, 3)])
    system = sparse.csc_matrix((values, (at, where)), shape=(3 * m, 3 * n))
    known = np.swapaxes(start.rotation, 1, 2).reshape(3 * n, 3)
    columns, given = _entries(free, 3), _entries(fixed, 3)
    solved = known.copy()
    solved[columns] = _least_squares(system[:, columns], -system[:, given] @ known[given])
    rotation = Rotation3.nearest(np.swapaxes(solved.reshape(n, 3, 3), 1, 2)).matrix
    # t_j - t_i = R_i z_t
    step = (rotation[graph.first] @ measured.translation[:, :, None])[..., 0]
    incidence = sparse.csc_matrix(
        (np.repeat([-1.0, 1.0], m), (np.tile(np.arange(m), 2), np.concatenate([graph.first, graph.second]))),
        shape=(m, n),
    )
    translation = start.translation.copy()
    translation[free] = _least_squares(incidence[:, free], step - incidence[:, fixed] @ translation[fixed])
    found: Motion = Rigid3(rotation, translation)
    if isinstance(graph.world_from_body, Rigid2):
        found = Rigid2.from_rigid3(Rigid3(rotation, translation))
    return replace(graph, world_from_body=found)


def optimize_weighted(
    graph: PoseGraph,
    config: PoseGraphConfig,
    weights: np.ndarray,
    progress: Callable[[int, float], bool] | None = None,
) -> PoseGraphResult:
    """Levenberg-Marquardt with a weight per edge (m,); arguments and errors as for `optimize_pose_graph`."""
    try:
        root = np.swapaxes(np.linalg.cholesky(graph.information), 1, 2) * np.sqrt(weights)[:, None, None]
    except np.linalg.LinAlgError as error:
        wrong = not_definite(graph.information)
        few = ", ".join(map(str, wrong[:5])) + (", ..." if len(wrong) > 5 else "")
        raise DegenerateGeometryError(
            f"the information matrices of {len(wrong)} of {len(weights)} edges are not positive definite: {few}"
        ) from error
    equations = _NormalEquations(graph)
    positions, damping, converged, iteration = graph.world_from_body, 0.0, False, 0
    between, residual = _residuals(graph, positions)
    squared = _squared(graph, residual)
    cost = initial = 0.5 * float((weights * squared).sum())
    for iteration in range(1, config.max_iterations + 1):
        by_second = inverse_right_jacobian(residual)
        by_first = root @ (-by_second @ between.inverse().adjoint())
        blocks, gradient = equations.fill(by_first, root @ by_second, (root @ residual[..., None])[..., 0])
        lowered = False
        for _ in range(12):
            step = equations.solve(blocks, gradient, damping)
            if step is not None:
                moved = _moved(positions, step)
                between_after, residual_after = _residuals(graph, moved)
                squared_after = _squared(graph, residual_after)
                after = 0.5 * float((weights * squared_after).sum())
                if after <= cost:
                    lowered = True
                    break
            damping = max(10.0 * damping, 1e-8)
        if not lowered:
            converged = True  # no step lowers the cost: the limit of rounding
            break
        gain, cost, positions = cost - after, after, moved
        between, residual, squared = between_after, residual_after, squared_after
        damping = 0.0 if damping < 1e-7 else 0.1 * damping
        if progress is not None and not progress(iteration, cost):
            break
        if gain <= config.relative_tolerance * cost + 1e-300:
            converged = True
            break
    return PoseGraphResult(positions, initial, cost, iteration, converged, weights > 0, squared)


def not_definite(information: Float64[np.ndarray, "m d d"]) -> Int64[np.ndarray, " e"]:
    """Edges whose matrices are not positive definite."""
    try:
        np.linalg.cholesky(information)
    except np.linalg.LinAlgError:
        return np.flatnonzero([not _has_factor(matrix) for matrix in information]).astype(np.int64)
    return np.empty(0, np.int64)


def _has_factor(matrix: np.ndarray) -> bool:
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


def _residuals(graph: PoseGraph, positions: Motion) -> tuple[Any, np.ndarray]:
    """x_i^-1 x_j of every edge, and log(z^-1 x_i^-1 x_j)."""
    between: Any = positions[graph.first].inverse() @ positions[graph.second]  # type: ignore[operator]
    return between, (graph.first_from_second.inverse() @ between).log()


def _squared(graph: PoseGraph, residual: np.ndarray) -> np.ndarray:
    return (residual * (graph.information @ residual[..., None])[..., 0]).sum(axis=1)


def _moved(positions: Motion, step: np.ndarray) -> Motion:
    moved: Any = type(positions).exp(step)
    return positions @ moved


class _NormalEquations:
    """The normal equations of a graph: laid out once, filled and factored at every step."""

    def __init__(self, graph: PoseGraph) -> None:
        n, d, first, second = len(graph), graph.dimension, graph.first, graph.second
        self.n, self.d, self.first, self.second = n, d, first, second
        self.free = np.setdiff1d(np.arange(n), _anchors(graph))
        column = np.full(n, -1)
        column[self.free] = np.arange(len(self.free))
        i, j = column[first], column[second]
        size, nodes = max(len(self.free), 1), np.arange(len(self.free))
        self.both = np.flatnonzero((i >= 0) & (j >= 0) & (i != j))
        self.rotated = (i < j)[self.both]
        keys = np.maximum(i, j)[self.both] * size + np.minimum(i, j)[self.both]
        unique, at = np.unique(np.concatenate([nodes * (size + 1), keys]), return_inverse=True)
        self.diagonal, self.between = at[: len(nodes)], at[len(nodes) :]
        pattern = BlockPattern(np.full(len(self.free), d), unique // size, unique % size)
        self.num_blocks, self.plan = len(unique), plan_cholesky(pattern)

    def fill(
        self, by_first: np.ndarray, by_second: np.ndarray, residual: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The blocks of J^T J, and J^T r."""
        a, b = np.swapaxes(by_first, 1, 2), np.swapaxes(by_second, 1, 2)
        corners = _summed(
            np.concatenate([self.first, self.second]), np.concatenate([a @ by_first, b @ by_second]), self.n
        )
        blocks = np.zeros((self.num_blocks, self.d, self.d))
        cross = np.where(
            self.rotated[:, None, None],
            b[self.both] @ by_first[self.both],
            a[self.both] @ by_second[self.both],
        )
        blocks += _summed(self.between, cross, self.num_blocks)
        blocks[self.diagonal] += corners[self.free]
        ends = np.concatenate([a @ residual[:, :, None], b @ residual[:, :, None]])
        gradient = _summed(np.concatenate([self.first, self.second]), ends, self.n)
        return blocks, gradient[self.free].ravel()

    def solve(self, blocks: np.ndarray, gradient: np.ndarray, damping: float) -> np.ndarray | None:
        """The damped Gauss-Newton step of every pose (n, d); None if the system is singular."""
        step = np.zeros((self.n, self.d))
        if len(self.free) == 0:
            return step
        damped, entry = blocks.copy(), np.arange(self.d)
        kept = damped[self.diagonal[:, None], entry, entry]
        # The floor keeps poses in place whose edges all have zero weight.
        damped[self.diagonal[:, None], entry, entry] += damping * kept + 1e-15 * kept.max()
        factor = self.plan.factorize(damped)
        if factor is None:
            return None
        found = factor.solve(-gradient)
        if not np.isfinite(found).all():
            return None
        step[self.free] = found.reshape(-1, self.d)
        return step


def _summed(row: np.ndarray, values: np.ndarray, num_rows: int) -> np.ndarray:
    """Sums of the values of each row."""
    which = sparse.csr_matrix((np.ones(len(row)), (row, np.arange(len(row)))), shape=(num_rows, len(row)))
    flat = values.reshape(len(row), int(np.prod(values.shape[1:])))
    return (which @ flat).reshape(num_rows, *values.shape[1:])


def _anchors(graph: PoseGraph) -> np.ndarray:
    """The fixed poses, and the first pose of every connected component without one, as its gauge is free."""
    n, m = len(graph), len(graph.first)
    edges = sparse.coo_matrix((np.ones(m), (graph.first, graph.second)), shape=(n, n))
    _, component = sparse.csgraph.connected_components(edges, directed=False)
    components, first = np.unique(component, return_index=True)
    without = ~np.isin(components, component[graph.fixed])
    return np.union1d(graph.fixed, first[without])


def _block_rows(rows: np.ndarray) -> np.ndarray:
    return np.repeat(rows[:, :, None], rows.shape[1], axis=2).ravel()


def _block_columns(index: np.ndarray, d: int) -> np.ndarray:
    columns = index[:, None] * d + np.arange(d)
    return np.repeat(columns[:, None, :], d, axis=1).ravel()


def _entries(index: np.ndarray, d: int) -> np.ndarray:
    return (index[:, None] * d + np.arange(d)).ravel()


def _least_squares(system: Any, target: np.ndarray) -> np.ndarray:
    if system.shape[1] == 0:
        return np.zeros((0, target.shape[1]))
    normal = (system.T @ system).tocsc()
    factors = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return factors.solve(np.ascontiguousarray(system.T @ target))
