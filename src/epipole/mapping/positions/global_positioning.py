"""Positions of all cameras and points at once, from directions alone (Pan, Barath, Pollefeys, Schoenberger, ECCV 2024)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float64, Int32, Int64

from epipole import _parallel
from epipole._checks import Declared, check_count, check_indices, check_offsets, checked, require_same_length
from epipole.errors import ConfigError
from epipole.mapping.positions import _positioning_kernels as kernels
from epipole.mapping.positions.start_positions import PairDirections, positions_from_pairs
from epipole.optim.block_cholesky import BlockPattern, CholeskyPlan, plan_cholesky

SCALE = 0.1
"""Sine of the angle beyond which Huber's loss is linear: about six degrees, as in the paper."""
NEAR_SCALE = 0.01
"""The same near the solution: wrong directions, which tracks have many of, would deform it."""
MAX_ITERATIONS = 200
SMALL_GAIN, PATIENCE = 2e-3, 3
"""It ends when three steps in succession each lower the cost by less than this fraction."""
NEAR = SCALE**2
"""Mean cost of a direction below which a start is near the solution: most directions fit within the linear part of the loss."""
FIRST_DAMPING, MOST_DAMPING, LEAST_DAMPING = 1e-4, 1e8, 1e-10


@dataclass(frozen=True, slots=True, eq=False)
class GlobalPositions(Declared):
    """Centers and points in one frame, whose origin and scale are arbitrary."""

    centers_in_world: Float64[np.ndarray, "n 3"]
    points_in_world: Float64[np.ndarray, "t 3"]
    angles_rad: Float64[np.ndarray, " r"]
    """Angle between each direction and the one from its camera to its point."""

    def __repr__(self) -> str:
        median = np.degrees(np.median(self.angles_rad)) if len(self.angles_rad) else 0.0
        return f"GlobalPositions({len(self.centers_in_world)} cameras, {len(self.points_in_world)} points, median {median:.2f} degrees)"


class _State(NamedTuple):
    centers: np.ndarray
    points: np.ndarray
    inverse: np.ndarray
    """(r,) inverse distance of each observation"""


@checked
def position_globally(
    num_images: int,
    offsets: Int64[np.ndarray, " t1"],
    image: Int32[np.ndarray, " r"],
    directions_in_world: Float64[np.ndarray, "r 3"],
    seed: int = 0,
    pairs: PairDirections | None = None,
) -> GlobalPositions:
    """Minimize sum rho(|v - s (X - c)|^2) over camera centers c, points X, and an inverse distance s of each observation.

    The residual is bilinear, so that it converges from random positions, and a wrong direction has a bounded influence (the
    residual is the sine of the angle at the best s). From random positions the number of iterations grows with the number of
    pairs from one end of the images to the other; the directions of the pairs give a better start. Levenberg-Marquardt;
    inverse distances, then points are eliminated, which leaves three unknowns per camera. The work of an iteration is the
    sum of the squared track lengths, and a sparse factorization.

    Args:
        num_images: number of images; each should have observations of several points that others observe.
        offsets: observations offsets[t] to offsets[t + 1] are those of point t; it should have three or more.
        image: image of each observation.
        directions_in_world: unit direction from the camera to the point, with the camera's rotation applied.
        seed: of the random positions at the start.
        pairs: directions between images. The start is random for what they do not determine, and for all if they fit badly.

    Raises:
        ShapeError: an image does not exist, or the arrays have different lengths.
        ConfigError: there are too many images, or a direction is not finite.
    """
    require_same_length(image=image, directions_in_world=directions_in_world)
    check_offsets(offsets, "offsets", len(image))
    check_count(num_images, "num_images")
    check_indices(image, "image", num_images)
    if not np.isfinite(directions_in_world).all():
        raise ConfigError("directions_in_world must be finite")
    if pairs is not None:
        if not np.isfinite(pairs.direction_in_world).all():
            raise ConfigError("pairs.direction_in_world must be finite")
        check_indices(pairs.image1, "pairs.image1", num_images)
        check_indices(pairs.image2, "pairs.image2", num_images)
    num_points = len(offsets) - 1
    seen = kernels.Directions(offsets, image.astype(np.int64), np.ascontiguousarray(directions_in_world))
    state, is_near = _random_start(seen, num_images, seed), False
    if num_points and num_images:
        if pairs is not None and len(pairs):
            start = _start_from(pairs, seen, state)
            is_near = _cost(seen, start) < NEAR * len(image)
            state = start if is_near else state
        state = _minimize(seen, state, is_near=is_near)
    ray = state.points[np.repeat(np.arange(num_points), np.diff(offsets))] - state.centers[image]
    along = (ray * directions_in_world).sum(axis=1)
    across = np.linalg.norm(np.cross(ray, directions_in_world), axis=1)
    return GlobalPositions(state.centers, state.points, np.arctan2(across, along))


def _random_start(seen: kernels.Directions, num_images: int, seed: int) -> _State:
    random = np.random.default_rng(seed)
    return _State(
        random.uniform(-1.0, 1.0, (num_images, 3)),
        random.uniform(-1.0, 1.0, (len(seen.offsets) - 1, 3)),
        np.ones(len(seen.image)),
    )


def _start_from(pairs: PairDirections, seen: kernels.Directions, other: _State) -> _State:
    """Positions that the pairs determine, as large as those of the other start, which has the rest."""
    found = positions_from_pairs(
        len(other.centers), seen.offsets, seen.image.astype(np.int32), seen.direction, pairs
    )
    known = np.isfinite(found.centers[:, 0])
    middle = found.centers[known].mean(axis=0)
    scale = other.centers[known].std() / max(
        float(np.sqrt(np.mean((found.centers[known] - middle) ** 2))), 1e-300
    )
    centers, points = ((x - middle) * scale for x in found)
    centers = np.where(known[:, None], centers, other.centers)
    points = np.where(np.isfinite(points), points, other.points)
    ray = np.repeat(points, np.diff(seen.offsets), axis=0) - centers[seen.image]
    inverse = (ray * seen.direction).sum(axis=1) / np.maximum((ray**2).sum(axis=1), 1e-300)
    return _State(centers, points, np.maximum(inverse, kernels.LEAST_INVERSE_DISTANCE))


def _cost(seen: kernels.Directions, state: _State) -> float:
    return float(kernels.robust_cost(seen, *state, SCALE, np.empty(len(seen.image))))


def _minimize(seen: kernels.Directions, state: _State, *, is_near: bool) -> _State:
    """Levenberg-Marquardt; far from the solution, points are refined alone only after it has converged."""
    system = _System.of(seen, len(state.centers), len(state.points))
    with _parallel.single_threaded_blas():
        if not is_near:
            state = _descend(system, seen, state, SCALE, refines=False)
        system.refine(seen, state)
        return _descend(system, seen, state, NEAR_SCALE, refines=True)


def _descend(
    system: _System, seen: kernels.Directions, state: _State, scale: float, *, refines: bool
) -> _State:
    """Levenberg-Marquardt with iteratively reweighted least squares."""
    weight, moved_weight = np.empty((2, len(seen.image)))
    cost = kernels.robust_cost(seen, *state, scale, weight)
    damping, num_small = FIRST_DAMPING, 0
    for _ in range(MAX_ITERATIONS):
        gain = 0.0
        while damping < MOST_DAMPING:
            moved = system.step(seen, state, weight, damping)
            if moved is not None and refines:
                system.refine(seen, moved)
            after = np.inf if moved is None else kernels.robust_cost(seen, *moved, scale, moved_weight)
            if moved is not None and after < cost:
                gain, cost, state = (cost - after) / cost, after, moved
                weight, moved_weight = moved_weight, weight
                damping = max(damping / 3.0, LEAST_DAMPING)
                break
            damping *= 4.0
        num_small = num_small + 1 if gain < SMALL_GAIN else 0
        if gain == 0.0 or num_small == PATIENCE:
            break
    return state


@dataclass(frozen=True, slots=True, eq=False)
class _System:
    """The normal equations of the centers."""

    plan: CholeskyPlan
    num_blocks: int
    diagonal: np.ndarray
    """Number of each image's diagonal block."""
    block_of_pair: np.ndarray
    """Number of the block of each pair of observations of a point."""
    kept: kernels.Eliminated
    half: np.ndarray

    @staticmethod
    def of(seen: kernels.Directions, num_images: int, num_points: int) -> _System:
        r = len(seen.image)
        point = np.repeat(np.arange(num_points), np.diff(seen.offsets))
        incidence = sparse.csr_array((np.ones(r), (seen.image, point)), shape=(num_images, num_points))
        shared = sparse.tril(incidence @ incidence.T + sparse.eye_array(num_images)).tocsr()
        shared.sort_indices()
        row_start, column = shared.indptr.astype(np.int64), shared.indices.astype(np.int64)
        row = np.repeat(np.arange(num_images), np.diff(row_start))
        num_pairs = kernels.find_blocks(seen, row_start, column, np.empty(0, np.int32))
        block_of_pair = np.empty(num_pairs, np.int32)
        kernels.find_blocks(seen, row_start, column, block_of_pair)
        return _System(
            plan_cholesky(BlockPattern(np.full(num_images, 3, np.int64), row, column)),
            len(column),
            np.flatnonzero(row == column),
            block_of_pair,
            kernels.Eliminated(
                *(np.empty((m, c)) for m, c in ((r, 6), (r, 3), (num_points, 6), (num_points, 3)))
            ),
            np.empty((int(np.diff(seen.offsets).max()), 3, 3)),
        )

    def step(
        self, seen: kernels.Directions, state: _State, weight: np.ndarray, damping: float
    ) -> _State | None:
        """The state that the damped normal equations lead to; None if they are singular."""
        blocks, gradient = np.zeros((self.num_blocks, 3, 3)), np.zeros_like(state.centers)
        kernels.reduce_points(
            seen,
            *state,
            weight,
            damping,
            self.kept,
            self.diagonal,
            self.block_of_pair,
            blocks,
            gradient,
            self.half,
        )
        axis = np.arange(3)
        own = blocks[self.diagonal[:, None], axis, axis]
        blocks[self.diagonal[:, None], axis, axis] = (1.0 + damping) * own + kernels.SMALLEST * own.mean()
        factor = self.plan.factorize(blocks)
        if factor is None:
            return None
        step = factor.solve(gradient.ravel()).reshape(-1, 3)
        moved = _State(state.centers + step, np.empty_like(state.points), np.empty_like(state.inverse))
        kernels.substitute_back(seen, *state, damping, step, self.kept, moved.points, moved.inverse)
        return moved

    def refine(self, seen: kernels.Directions, state: _State) -> None:
        """Lower the cost of the points and inverse distances of a state, in place."""
        kernels.refine_points(seen, *state, NEAR_SCALE, self.kept, np.empty(3))
