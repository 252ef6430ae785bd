"""Terms of bundle adjustment that do not come from pixels: priors of poses, gravity, intrinsics, points and distances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from epipole.geometry import Rigid3, skew
from epipole.geometry.tangents import inverse_left_jacobian
from epipole.optim.bundle_layout import BundleLayout, BundleState
from epipole.optim.bundle_problem import BundlePriors, PathFactors


@dataclass(frozen=True, slots=True, eq=False)
class PriorTerms:
    """Half the sum of squares, its gradient and Gauss-Newton matrix, node by node."""

    cost: float
    gradient: np.ndarray
    """(nodes, lanes)"""
    diagonal: np.ndarray
    """(nodes, lanes, lanes)"""
    pairs: tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...]
    """Blocks (d, 3, 3) or (d, 6, 6) of pairs of nodes: rows and columns in the lower triangle, values."""


class _Sums:
    """Accumulated terms."""

    def __init__(self, num_nodes: int, num_lanes: int) -> None:
        self.cost = 0.0
        self.gradient = np.zeros((num_nodes, num_lanes))
        self.diagonal = np.zeros((num_nodes, num_lanes, num_lanes))
        self.pairs: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def add(self, node: np.ndarray, jacobian: np.ndarray, residual: np.ndarray, first: int = 0) -> None:
        """Add terms with Jacobians (d, r, c) and residuals (d, r) to the columns of nodes, starting at `first`."""
        mine = node >= 0
        node, jacobian, residual = node[mine], jacobian[mine], residual[mine]
        columns = slice(first, first + jacobian.shape[2])
        np.add.at(self.gradient[:, columns], node, np.einsum("dri,dr->di", jacobian, residual))
        block = np.einsum("dri,drj->dij", jacobian, jacobian)
        np.add.at(self.diagonal[:, columns, columns], node, block)


def prior_terms(priors: BundlePriors | None, layout: BundleLayout, state: BundleState) -> PriorTerms:
    """All terms of the priors at a state."""
    terms = _Sums(layout.num_nodes, len(layout.lanes))
    if priors is not None:
        positions = Rigid3(state.rig_from_world[:, :9].reshape(-1, 3, 3), state.rig_from_world[:, 9:])
        _add_positions(priors, layout, positions, terms)
        _add_motions(priors, layout, positions, terms)
        _add_gravity(priors, layout, positions, terms)
        _add_params(priors, layout, state.params, terms)
        _add_points(priors, layout, state.points, terms)
        _add_distances(priors, layout, state.points, terms)
        for path in priors.paths:
            _add_path(path, layout, positions, terms)
    terms.gradient[layout.fixed_mask] = 0.0
    terms.diagonal[layout.fixed_mask] = 0.0
    np.swapaxes(terms.diagonal, 1, 2)[layout.fixed_mask] = 0.0
    return PriorTerms(terms.cost, terms.gradient, terms.diagonal, tuple(terms.pairs))


def _add_positions(priors: BundlePriors, layout: BundleLayout, positions: Rigid3, terms: _Sums) -> None:
    """Cauchy loss of (center - expected) / sigma; d center / d translation tangent = -R^T."""
    if priors.position_in_world is None:
        return
    known = np.flatnonzero(np.isfinite(priors.position_in_world).all(axis=1) & (layout.nodes.frame >= 0))
    sigma = np.asarray(priors.position_sigma, np.float64)
    weight = 1.0 / (sigma[known] if sigma.ndim else np.full((len(known), 3), sigma))
    rotated = np.swapaxes(positions.rotation[known], 1, 2)
    residual = weight * (positions[known].centers() - priors.position_in_world[known])
    squared = (residual**2).sum(axis=1)
    robust = 1.0 / np.sqrt(1.0 + squared)[:, None]
    terms.cost += 0.5 * float(np.log1p(squared).sum())
    terms.add(layout.nodes.frame[known], -(robust * weight)[..., None] * rotated, robust * residual)


def _add_motions(priors: BundlePriors, layout: BundleLayout, positions: Rigid3, terms: _Sums) -> None:
    """The residual r = log(x expected^-1); under exp(xi) x it changes by the inverse left Jacobian of r."""
    if priors.rig_from_world is None or priors.rig_information is None:
        return
    known = np.flatnonzero(priors.rig_information.any(axis=(1, 2)) & (layout.nodes.frame >= 0))
    residual = (positions[known] @ priors.rig_from_world[known].inverse()).log()
    root = np.swapaxes(np.linalg.cholesky(priors.rig_information[known]), 1, 2)
    weighed = (root @ residual[..., None])[..., 0]
    terms.cost += 0.5 * float((weighed**2).sum())
    terms.add(layout.nodes.frame[known], root @ inverse_left_jacobian(residual), weighed)


def _add_gravity(priors: BundlePriors, layout: BundleLayout, positions: Rigid3, terms: _Sums) -> None:
    """The residual (R down_in_world - down_in_rig) / sigma; d(R d) / d rotation tangent = -[R d]x."""
    if priors.down_in_rig is None:
        return
    known = np.flatnonzero(np.isfinite(priors.down_in_rig).all(axis=1) & (layout.nodes.frame >= 0))
    down = positions.rotation[known] @ (np.array(priors.down_in_world) / np.linalg.norm(priors.down_in_world))
    residual = (down - priors.down_in_rig[known]) / priors.down_sigma_rad
    terms.cost += 0.5 * float((residual**2).sum())
    terms.add(layout.nodes.frame[known], -skew(down) / priors.down_sigma_rad, residual, first=3)


def _add_params(priors: BundlePriors, layout: BundleLayout, params: np.ndarray, terms: _Sums) -> None:
    if priors.params_expected is None or priors.params_sigma is None:
        return
    for rank in range(int(layout.num_free.max(initial=0))):
        own = np.flatnonzero(layout.num_free > rank)
        which, node = layout.free_params[own, rank], layout.nodes.camera[own]
        weight = 1.0 / priors.params_sigma[own, which]
        residual = weight * (params[own, which] - priors.params_expected[own, which])
        column = layout.nodes.camera_column[own] + rank
        terms.cost += 0.5 * float((residual**2).sum())
        np.add.at(terms.gradient, (node, column), weight * residual)
        np.add.at(terms.diagonal, (node, column, column), weight**2)


def _add_points(priors: BundlePriors, layout: BundleLayout, points: np.ndarray, terms: _Sums) -> None:
    """The residual (X - expected) / sigma of each coordinate."""
    if priors.points is None:
        return
    own = priors.points.point
    weight = 1.0 / priors.points.sigma
    residual = np.where(weight > 0, weight * (points[own] - priors.points.expected), 0.0)
    terms.cost += 0.5 * float((residual**2).sum())
    terms.add(layout.nodes.point[own], weight[:, :, None] * np.eye(3), residual)


def _add_distances(priors: BundlePriors, layout: BundleLayout, points: np.ndarray, terms: _Sums) -> None:
    """The residual (|X_i - X_j| - d) / sigma."""
    if priors.distances is None:
        return
    first, second = priors.distances.first, priors.distances.second
    weight = 1.0 / priors.distances.sigma
    between = points[first] - points[second]
    length = np.linalg.norm(between, axis=1)
    residual = weight * (length - priors.distances.distance)
    jacobian = (weight / np.maximum(length, 1e-300))[:, None, None] * between[:, None, :]
    terms.cost += 0.5 * float((residual**2).sum())
    a, b = layout.nodes.point[first], layout.nodes.point[second]
    terms.add(a, jacobian, residual[:, None])
    terms.add(b, -jacobian, residual[:, None])
    both = (a >= 0) & (b >= 0)
    block = -np.einsum("dri,drj->dij", jacobian, jacobian)[both]
    terms.pairs.append((np.maximum(a, b)[both], np.minimum(a, b)[both], block))


def _add_path(path: PathFactors, layout: BundleLayout, positions: Rigid3, terms: _Sums) -> None:
    """All pairs of the path's free frames."""
    cost, gradient, matrix = path.linearized(positions[path.frames])
    terms.cost += cost
    node = layout.nodes.frame[path.frames]
    mine = np.flatnonzero(node >= 0)
    node, matrix = node[mine], matrix[mine][:, :, mine]
    terms.gradient[node, :6] += gradient[mine]
    terms.diagonal[node, :6, :6] += matrix[np.arange(len(node)), :, np.arange(len(node))]
    free = ~layout.fixed_mask[node, :6]
    first, second = np.nonzero(node[:, None] > node)
    block = matrix[first, :, second] * (free[first][:, :, None] & free[second][:, None, :])
    terms.pairs.append((node[first], node[second], block))
