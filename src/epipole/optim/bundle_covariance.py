"""First-order covariances of adjusted poses, intrinsics and points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from epipole import _parallel
from epipole._checks import checked
from epipole._checks.arrays import as_array
from epipole.config import options_of
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.optim import _bundle_arrays as arrays
from epipole.optim import _bundle_reduced_kernels as reduced_kernels
from epipole.optim.bundle_adjustment import BundleConfig, BundleResult, with_result
from epipole.optim.bundle_layout import BundleLayout, BundleState, initial_state
from epipole.optim.bundle_problem import NUM_PARAMS, BundleProblem
from epipole.optim.bundle_system import BundleSystem, Linearization, LinearSolver
from epipole.optim.cluster_robust import error_growth

_NO_DAMPING = 1e-12
_UNKNOWN = 1e9
"""Ratio of variances, with and without the other unknowns free, above which an unknown is undetermined: rounding rules."""


_NOTHING = 1e-250
"""Smallest curvature of an observed unknown: below it, only the damping keeps the matrix definite."""


@dataclass(frozen=True, slots=True, eq=False)
class BundleCovariance:
    """Covariances; zero for constants, infinite for what the images do not determine."""

    rig_from_world: Float64[np.ndarray, "f 6 6"]
    """Of xi in exp(xi) @ rig_from_world, (translation, rotation)."""
    cam_from_rig: Float64[np.ndarray, "s 6 6"]
    camera_params: Float64[np.ndarray, "c 12 12"]
    points_in_world: Float64[np.ndarray, "p 3 3"]
    noise_px: float
    """Standard deviation of a pixel coordinate assumed for them."""

    def __repr__(self) -> str:
        return (
            f"BundleCovariance({len(self.rig_from_world)} frames, {len(self.camera_params)} cameras, "
            f"{len(self.points_in_world)} points, noise {self.noise_px:.3g} px)"
        )


@checked
def bundle_covariance(
    problem: BundleProblem,
    result: BundleResult,
    config: BundleConfig | None = None,
    *,
    noise_px: float | None = None,
    clustered: bool = False,
) -> BundleCovariance:
    """Covariances at a minimum: selected blocks of the inverse of J^T J (Takahashi et al. 1973), times the noise.

    They assume independent, small pixel errors of equal size, and are relative to what the problem holds constant; where
    the gauge is free they are infinite (see `with_fixed_gauge`). Priors count as if their standard deviations scaled with
    the noise, as they are weighted against pixels of unit standard deviation.

    Args:
        problem: the problem that was adjusted.
        result: its minimum.
        config: options of the adjustment, for the loss.
        noise_px: standard deviation of the pixel errors; None: that of the residuals, after the loss.
        clustered: allow for errors of a point that are correlated between images and with neighbors in the list of points:
            scale the covariances, except those of points without a prior, by the points' scores (see `cluster_robust`).

    Raises:
        DegenerateGeometryError: there are no more residuals than unknowns, and noise_px is not given.
        ShapeError: the result belongs to another problem.
        ConfigError: noise_px is negative.
    """
    config = options_of(BundleConfig, config)
    found = with_result(problem, result)
    if noise_px is not None and not 0 <= noise_px < 1e150:
        raise ConfigError(f"noise_px must be from 0 to 1e150, got {noise_px}")
    with _parallel.single_threaded_blas():
        system, state, equations = _at_minimum(found, result.used_mask, config)
        layout = system.layout
        if noise_px is None:
            noise_px = _residual_noise(layout, result)
        inverse = system.inverse_blocks(equations)
        nodes, points = _covariances_of_nodes_and_points(system, equations.blocks, inverse)
        variance = noise_px**2
        nodes *= variance
        if clustered:
            loss = config.loss, config.loss_scale_px
            nodes *= error_growth(system, state, equations, nodes, loss)[:, None, None]
        points *= variance
        kept = layout.nodes.point >= 0
        points[kept] = nodes[layout.nodes.point[kept], :3, :3]
    return BundleCovariance(
        _of_nodes(nodes, layout.nodes.frame),
        _of_nodes(nodes, layout.nodes.sensor),
        _of_params(nodes, layout),
        points,
        noise_px,
    )


@checked
def bundle_variance(
    problem: BundleProblem,
    result: BundleResult,
    derivative: Float64[np.ndarray, "f 6"],
    config: BundleConfig | None = None,
) -> float:
    """Variance, for unit pixel noise, of a quantity that depends on many frames: g^T C g, at a minimum.

    Args:
        problem: the problem that was adjusted.
        result: its minimum.
        derivative: of the quantity by xi of exp(xi) @ rig_from_world.
        config: options of the adjustment, for the loss.

    Raises:
        DegenerateGeometryError: the problem is underdetermined.
        ShapeError: array sizes do not match.
    """
    if derivative.shape != problem.frame_free.shape:
        raise ShapeError(f"derivative must be {problem.frame_free.shape}, got {derivative.shape}")
    with _parallel.single_threaded_blas():
        found = with_result(problem, result)
        system, _, equations = _at_minimum(found, result.used_mask, options_of(BundleConfig, config))
        node, rhs = system.layout.nodes.frame, np.zeros_like(equations.rhs)
        rhs[node[node >= 0], :6] = derivative[node >= 0]
        rhs[system.layout.fixed_mask] = 0.0
        step, _ = system.solve(replace(equations, rhs=rhs))
        if step is None:
            raise DegenerateGeometryError(
                "the normal equations are not positive definite, so the problem is underdetermined"
            )
    return float((rhs * step).sum())


def _at_minimum(
    found: BundleProblem, used: np.ndarray, config: BundleConfig
) -> tuple[BundleSystem, BundleState, Linearization]:
    """The undamped normal equations over the observations that were used, even if visibility has changed since.

    Raises:
        ShapeError: the mask does not match the problem's observations.
    """
    used = as_array(used, "result.used_mask", np.dtype(bool))
    if used.shape != (len(found.pixels),):
        raise ShapeError("result.used_mask does not match the observations of this problem")
    system = BundleSystem(
        found, config.loss, config.loss_scale_px, LinearSolver.DIRECT, single_precision=False
    )
    system.layout.observations.used[:] = used
    state = initial_state(found)
    return system, state, system.linearize(state, _NO_DAMPING)


def _residual_noise(layout: BundleLayout, result: BundleResult) -> float:
    """Standard deviation of the pixels according to the residuals."""
    freedom = 2 * int(result.used_mask.sum()) - _num_unknowns(layout)
    if freedom <= 0:
        raise DegenerateGeometryError(
            "there are no more residuals than unknowns, so the noise cannot be estimated: pass noise_px"
        )
    return float(np.sqrt(2.0 * result.final_cost / freedom))


def _covariances_of_nodes_and_points(
    system: BundleSystem, blocks: np.ndarray, inverse: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Blocks of the inverse for unit noise: of the nodes (n, lanes, lanes), and of the points (p, 3, 3)."""
    layout = system.layout
    diagonal = np.flatnonzero(system.pattern.row == system.pattern.column)
    alone = np.einsum("nii->ni", blocks[diagonal])
    own = np.arange(len(layout.lanes)) < layout.entries.width[:, None]
    known_to = alone * np.einsum("nii->ni", inverse[diagonal])
    lost = ((known_to > _UNKNOWN) | (own & (alone < _NOTHING))).any(axis=1)
    points = np.empty((len(layout.unknowns.role), 3, 3))
    _parallel.map_chunks(
        lambda a, b, _: reduced_kernels.point_covariances(
            layout.entries,
            a,
            b,
            system.kept,
            system.row_start,
            system.pattern.column,
            inverse,
            layout.entries.width,
            points,
        ),
        len(points),
        layout.num_chunks,
    )
    points[_unknown_points(layout, lost, system.kept.factor, points)] = np.inf
    nodes = inverse[diagonal]
    nodes[layout.fixed_mask] = 0.0
    np.swapaxes(nodes, 1, 2)[layout.fixed_mask] = 0.0
    nodes[lost] = np.inf
    return nodes, points


def _num_unknowns(layout: BundleLayout) -> int:
    nodes = int(layout.entries.width.sum()) - int(layout.fixed_mask.sum())
    return nodes + 3 * int((layout.unknowns.role == arrays.ELIMINATED).sum())


def _unknown_points(
    layout: BundleLayout, lost: np.ndarray, factor: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """Mask of free points without parallax, observed only by undetermined frames, or undetermined for other reasons."""
    i0, l10, i1, l20, l21, i2 = factor.T
    with np.errstate(divide="ignore", invalid="ignore"):
        # Variance of each coordinate before it was coupled to the others, 1 / V_aa, against that after, 1 / d_a.
        weak = (i2**2 * (1.0 / i2**2 + l20**2 + l21**2) > _UNKNOWN) | (
            i1**2 * (1.0 / i1**2 + l10**2) > _UNKNOWN
        )
    k10, k21 = -i1 * l10 * i0, -i2 * l21 * i1
    k20 = -i2 * (l20 * i0 + l21 * k10)
    all_else_fixed = np.stack([i0**2 + k10**2 + k20**2, i1**2 + k21**2, i2**2], axis=1)
    drifting = (np.einsum("nii->ni", covariance) > _UNKNOWN * all_else_fixed).any(axis=1)
    entries = layout.entries
    by_frame = entries.node >= layout.num_border
    of_known, of_lost = np.zeros((2, len(factor)), bool)
    of_known[entries.point[by_frame & ~lost[entries.node]]] = True
    of_lost[entries.point[by_frame & lost[entries.node]]] = True
    unknown = weak | (i0 == 0.0) | drifting | (of_lost & ~of_known)
    return (layout.unknowns.role == arrays.ELIMINATED) & unknown


def _of_nodes(inverse: np.ndarray, node: np.ndarray) -> np.ndarray:
    out = np.zeros((len(node), 6, 6))
    free = node >= 0
    out[free] = inverse[node[free], :6, :6]
    return out


def _of_params(inverse: np.ndarray, layout: BundleLayout) -> np.ndarray:
    out = np.zeros((len(layout.num_free), NUM_PARAMS, NUM_PARAMS))
    for c in np.flatnonzero(layout.num_free):
        own = layout.free_params[c, : layout.num_free[c]]
        at = layout.nodes.camera_column[c] + np.arange(len(own))
        out[np.ix_([c], own, own)] = inverse[layout.nodes.camera[c]][np.ix_(at, at)]
    return out
