"""Bundle adjustment: all poses, points and intrinsics together, by Levenberg-Marquardt on the Schur complement."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int32, Int64
from scipy.linalg import cho_factor, cho_solve

from epipole import _parallel
from epipole._checks import require_same_length
from epipole.cameras import CameraModel
from epipole.errors import ShapeError
from epipole.geometry import Rigid3
from epipole.optim import _bundle_kernels as kernels
from epipole.optim.losses import Loss

_CHUNK_OBSERVATIONS = 3000
_MAX_SYSTEM_BYTES = 256 << 20
"""Bound on the copies of the reduced system that parallel chunks fill."""


class _Observations(NamedTuple):
    """Observations sorted by point, as the kernels take them."""

    offsets: np.ndarray
    frame: np.ndarray
    sensor: np.ndarray
    camera: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class BundleProblem:
    """What is adjusted. Observations are grouped by point: those of point j are offsets[j] to offsets[j + 1]."""

    rig_from_world: Rigid3
    """One row per frame."""
    cam_from_rig: Rigid3
    """One row per sensor; identity for a single camera; constant."""
    camera_model: Int32[np.ndarray, " c"]
    camera_params: Float64[np.ndarray, "c 8"]
    points_in_world: Float64[np.ndarray, "p 3"]
    offsets: Int64[np.ndarray, " p1"]
    frame: Int32[np.ndarray, " k"]
    sensor: Int32[np.ndarray, " k"]
    camera: Int32[np.ndarray, " k"]
    pixels: Float64[np.ndarray, "k 2"]
    frame_free: Float64[np.ndarray, "f 6"]
    """1 where a tangent component (translation, rotation) of a frame may change, else 0."""
    params_free: Float64[np.ndarray, "c 8"]
    """1 where a camera parameter may change, else 0."""
    point_free: Float64[np.ndarray, " p"]
    """1 where a point may move, else 0."""
    prior_position: Float64[np.ndarray, "f 3"]
    """Expected frame centres in world coordinates; NaN rows for none."""
    params_expected: Float64[np.ndarray, "c 8"] | None = None
    """Expected camera parameters, with `params_sigma`; None: nothing is known."""
    params_sigma: Float64[np.ndarray, "c 8"] | None = None
    """Standard deviations of the camera parameters about what is expected; infinite for no expectation."""
    prior_sigma: float = 1.0
    """Standard deviation of the prior positions, in world units; their loss is Cauchy's at this scale."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleConfig:
    """Options of bundle adjustment."""

    loss: Loss = Loss.TRIVIAL
    loss_scale_px: float = 1.0
    max_iterations: int = 50
    function_tolerance: float = 1e-6
    """Stop when the cost falls by less than this share of itself."""
    initial_damping: float = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class BundleResult:
    """The adjusted quantities and how they were reached."""

    rig_from_world: Rigid3
    camera_params: Float64[np.ndarray, "c 8"]
    points_in_world: Float64[np.ndarray, "p 3"]
    initial_cost: float
    final_cost: float
    num_iterations: int
    seconds: float
    converged: bool

    def __repr__(self) -> str:
        return (
            f"BundleResult(cost {self.initial_cost:.6g} -> {self.final_cost:.6g}, {self.num_iterations} iterations, "
            f"{self.seconds:.2f} s, {'converged' if self.converged else 'stopped early'})"
        )


@dataclass(slots=True)
class _State:
    frames: np.ndarray  # (f, 12): R row by row, t
    params: np.ndarray
    points: np.ndarray


@dataclass(frozen=True, slots=True)
class _Layout:
    """Which columns of the reduced system belong to which frame and camera: frames first, cameras after."""

    frame_column: np.ndarray
    camera_column: np.ndarray
    free_params: np.ndarray
    num_free: np.ndarray
    size: int
    held: np.ndarray = field(repr=False)  # columns of frames' components that may not change


def adjust_bundle(problem: BundleProblem, config: BundleConfig | None = None) -> BundleResult:
    """Minimise half the sum of rho(|project - pixel|^2) (Triggs et al. 2000), dense Cholesky of the Schur complement.

    The damping follows Nielsen (1999): it falls by the gain ratio of actual to predicted decrease and doubles
    its growth on each rejected step. The cost never rises.

    Raises:
        ShapeError: the arrays of the problem do not fit together.
    """
    config = config or BundleConfig()
    begin = time.perf_counter()
    solver = _Solver(problem, config)
    state = solver.initial_state()
    cost = initial = solver.cost(state)
    damping, growth, converged, iteration = config.initial_damping, 2.0, not solver.has_unknowns, 0
    while not converged and iteration < config.max_iterations and np.isfinite(cost):
        iteration += 1
        candidate, predicted = solver.step(state, damping)
        after = solver.cost(candidate) if candidate is not None else np.inf
        gain = (cost - after) / predicted if predicted > 0 else -1.0
        if candidate is not None and after <= cost and gain > 0:
            converged = cost - after <= config.function_tolerance * cost
            state, cost = candidate, after
            damping *= max(1.0 / 10.0, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
            growth = 2.0
        else:
            converged = 0 <= predicted <= config.function_tolerance * 1e-3 * cost or damping > 1e12
            damping, growth = damping * growth, growth * 2.0
        damping = max(damping, 1e-10)
    return BundleResult(
        Rigid3(state.frames[:, :9].reshape(-1, 3, 3).copy(), state.frames[:, 9:].copy()),
        state.params,
        state.points,
        initial,
        cost,
        iteration,
        time.perf_counter() - begin,
        converged,
    )


def free_params_mask(
    models: Int32[np.ndarray, " c"],
    *,
    focal: bool = True,
    principal_point: bool = False,
    distortion: bool = True,
) -> Float64[np.ndarray, "c 8"]:
    """Mask of intrinsics that may change, by their meaning."""
    mask = np.zeros((len(models), kernels.BLOCK))
    for row, model in enumerate(models):
        kind = CameraModel(int(model))
        mask[row, list(kind.focal_indices)] = float(focal)
        mask[row, list(kind.principal_point_indices)] = float(principal_point)
        mask[row, list(kind.distortion_indices)] = float(distortion)
    return mask


def with_fixed_gauge(problem: BundleProblem) -> BundleProblem:
    """Hold the seven freedoms that pictures leave open: one frame, and one coordinate of a second one's place.

    The frame with most observations stays; of the frame farthest from it, the component of its translation
    tangent along the line between both (the largest, in its own axes) stays, which holds the scale. Holding
    components, rather than undoing a solved step, keeps the predicted decrease true.
    """
    free = problem.frame_free.copy()
    counts = np.bincount(problem.frame, minlength=len(free))
    movable = np.flatnonzero(free.any(axis=1) & (counts > 0))
    if len(movable) < 2 or not free[movable].all() or np.isfinite(problem.prior_position).any():
        return problem
    if (counts[~free.any(axis=1)] > 0).sum() >= 2:
        return problem
    first = movable[np.argmax(counts[movable])]
    free[first] = 0.0
    centers = problem.rig_from_world.centers()
    others = movable[movable != first]
    second = others[np.argmax(np.linalg.norm(centers[others] - centers[first], axis=1))]
    along = problem.rig_from_world.rotation[second] @ (centers[second] - centers[first])
    free[second, np.argmax(np.abs(along))] = 0.0
    return replace(problem, frame_free=free)


class _Solver:
    """The linear algebra of one problem; keeps the constant arrays."""

    def __init__(self, problem: BundleProblem, config: BundleConfig) -> None:
        require_same_length(
            frame=problem.frame, sensor=problem.sensor, camera=problem.camera, pixels=problem.pixels
        )
        if len(problem.offsets) != len(problem.points_in_world) + 1 or problem.offsets[-1] != len(
            problem.frame
        ):
            raise ShapeError(
                "offsets must have one entry more than points and end at the number of observations"
            )
        self.problem, self.config = problem, config
        self.observations = _Observations(
            problem.offsets,
            problem.frame,
            problem.sensor,
            problem.camera,
            np.ascontiguousarray(problem.pixels),
        )
        self.sensors = _rows(problem.cam_from_rig)
        self.layout = _lay_out(problem)
        self.unknowns = kernels.Unknowns(
            *(problem.point_free, problem.frame_free, self.layout.frame_column, self.layout.camera_column),
            *(self.layout.free_params, self.layout.num_free),
        )
        self.has_unknowns = bool(self.layout.size or problem.point_free.any())
        self.eliminated = _room_for_elimination(len(problem.frame), len(problem.points_in_world))
        copies = _MAX_SYSTEM_BYTES // max(8 * self.layout.size**2, 1)
        # Small problems stay in one piece: handing out a chunk costs as much as a few hundred observations.
        self.num_chunks = int(np.clip(len(problem.frame) // _CHUNK_OBSERVATIONS, 1, 16))
        self.num_systems = min(self.num_chunks, int(np.clip(copies, 1, 8)))
        self.params_weight = np.zeros_like(problem.camera_params)
        self.params_expected = problem.camera_params
        if problem.params_expected is not None and problem.params_sigma is not None:
            self.params_weight = np.where(problem.params_free > 0, 1.0 / problem.params_sigma**2, 0.0)
            self.params_expected = problem.params_expected
        self.has_prior = np.isfinite(problem.prior_position).all(axis=1)

    def initial_state(self) -> _State:
        return _State(
            _rows(self.problem.rig_from_world),
            self.problem.camera_params.copy(),
            self.problem.points_in_world.copy(),
        )

    def _scene(self, state: _State) -> kernels.Scene:
        return kernels.Scene(
            state.frames, self.sensors, self.problem.camera_model, state.params, state.points
        )

    def _loss(self) -> tuple[int, float]:
        return int(self.config.loss), float(self.config.loss_scale_px**2)

    def cost(self, state: _State) -> float:
        """Half the robust sum of squares, priors included."""
        parts = _parallel.map_chunks(
            lambda a, b, _: kernels.total_cost(self.observations, a, b, self._scene(state), *self._loss()),
            len(state.points),
            self.num_chunks,
        )
        offsets = state.params - self.params_expected
        return (
            float(sum(parts))
            + self._prior_terms(state)[0]
            + 0.5 * float((self.params_weight * offsets**2).sum())
        )

    def step(self, state: _State, damping: float) -> tuple[_State | None, float]:
        """One damped Gauss-Newton step: the moved state (None if the system is not definite), predicted decrease."""
        system, gradient, rhs = self._reduced_system(state, damping)
        _, prior_gradient, prior_diagonal = self._prior_terms(state)
        n, layout = self.layout.size, self.layout
        diagonal = np.einsum("ii->i", system)
        undamped = self._undamped_diagonal
        for f in np.flatnonzero(self.has_prior & (layout.frame_column >= 0)):
            c = layout.frame_column[f]
            gradient[c : c + 3] += prior_gradient[f]
            diagonal[c : c + 3] += prior_diagonal[f]
            undamped[c : c + 3] += prior_diagonal[f]
        for c in np.flatnonzero(layout.num_free):
            chosen = layout.free_params[c, : layout.num_free[c]]
            columns = layout.camera_column[c] + np.arange(len(chosen))
            weight = self.params_weight[c, chosen]
            gradient[columns] += weight * (state.params[c, chosen] - self.params_expected[c, chosen])
            diagonal[columns] += weight
            undamped[columns] += weight
        damp = damping * undamped + 1e-12
        diagonal += damp
        diagonal[layout.held] = 1.0
        step = np.zeros(n)
        if n:
            try:
                factor = cho_factor(system, lower=True, overwrite_a=True, check_finite=False)
            except np.linalg.LinAlgError:
                return None, -1.0
            step = cho_solve(factor, rhs - gradient, check_finite=False)
            step[layout.held] = 0.0
            if not np.isfinite(step).all():
                return None, -1.0
        moved = _State(
            self._moved_frames(state, step), self._moved_params(state, step), np.empty_like(state.points)
        )
        parts = _parallel.map_chunks(
            lambda a, b, _: kernels.substitute_back(
                self.problem.offsets, a, b, state.points, self.eliminated, step, moved.points
            ),
            len(state.points),
            self.num_chunks,
        )
        return moved, float(sum(parts)) + 0.5 * float(step @ (damp * step - gradient))

    def _reduced_system(self, state: _State, damping: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        n = self.layout.size

        def build(start: int, stop: int, _: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            s, g, rhs = np.zeros((n, n)), np.zeros(n), np.zeros(n)
            kernels.build_reduced_system(
                *(self.observations, start, stop, self._scene(state), self.unknowns, *self._loss()),
                *(damping, self.eliminated, s, g, rhs),
            )
            return s, g, rhs

        parts = _parallel.map_chunks(build, len(state.points), self.num_systems)
        system, gradient, rhs = parts[0] if parts else (np.zeros((n, n)), np.zeros(n), np.zeros(n))
        for s, g, r in parts[1:]:
            system += s
            gradient += g
            rhs += r
        # Damp by the Schur complement's own diagonal: it scales as the problem does.
        self._undamped_diagonal = np.maximum(np.einsum("ii->i", system).copy(), 0.0)
        return system, gradient, rhs

    def _moved_frames(self, state: _State, step: np.ndarray) -> np.ndarray:
        moved = state.frames.copy()
        free = np.flatnonzero(self.layout.frame_column >= 0)
        if len(free):
            xi = step[self.layout.frame_column[free][:, None] + np.arange(6)]
            old = Rigid3(state.frames[free, :9].reshape(-1, 3, 3), state.frames[free, 9:])
            moved[free] = _rows(Rigid3.exp(xi) @ old)
        return moved

    def _moved_params(self, state: _State, step: np.ndarray) -> np.ndarray:
        moved = state.params.copy()
        for c in np.flatnonzero(self.layout.num_free):
            count, first = self.layout.num_free[c], self.layout.camera_column[c]
            moved[c, self.layout.free_params[c, :count]] += step[first : first + count]
        return moved

    def _prior_terms(self, state: _State) -> tuple[float, np.ndarray, np.ndarray]:
        """Cauchy loss of (centre - prior) / sigma; d centre / d translation tangent = -R^T, so J^T J is diagonal."""
        if not self.has_prior.any():
            return 0.0, np.zeros((len(state.frames), 3)), np.zeros(len(state.frames))
        rotation = state.frames[:, :9].reshape(-1, 3, 3)
        centers = -(np.swapaxes(rotation, 1, 2) @ state.frames[:, 9:, None])[..., 0]
        weight = 1.0 / self.problem.prior_sigma**2
        residual = np.where(self.has_prior[:, None], centers - self.problem.prior_position, 0.0)
        squared = weight * (residual**2).sum(axis=1)
        robust = weight / (1.0 + squared)
        gradient = -robust[:, None] * (rotation @ residual[..., None])[..., 0]
        return 0.5 * float(np.log1p(squared).sum()), gradient, robust * self.has_prior


def _room_for_elimination(num_observations: int, num_points: int) -> kernels.Eliminated:
    return kernels.Eliminated(
        np.empty((2 * num_observations, kernels.BLOCK, 3)),
        np.empty(2 * num_observations, np.int64),
        np.empty(2 * num_observations, np.int64),
        np.empty(num_points, np.int64),
        np.empty((num_points, 3, 3)),
        np.empty((num_points, 3)),
        np.empty((num_points, 3)),
    )


def _rows(motion: Rigid3) -> np.ndarray:
    return np.concatenate([motion.rotation.reshape(-1, 9), motion.translation], axis=1)


def _lay_out(problem: BundleProblem) -> _Layout:
    used_frame = np.bincount(problem.frame, minlength=len(problem.frame_free)) > 0
    used_camera = np.bincount(problem.camera, minlength=len(problem.params_free)) > 0
    movable = problem.frame_free.any(axis=1) & used_frame
    frame_column = np.where(movable, 6 * (np.cumsum(movable) - 1), -1).astype(np.int64)
    free = problem.params_free * used_camera[:, None] > 0
    num_free = free.sum(axis=1).astype(np.int64)
    num_frame_columns = 6 * int(movable.sum())
    camera_column = num_frame_columns + np.concatenate([[0], np.cumsum(num_free)[:-1]]).astype(np.int64)
    free_params = np.zeros(free.shape, np.int64)
    for c in range(len(free)):
        free_params[c, : num_free[c]] = np.flatnonzero(free[c])
    held = np.flatnonzero(problem.frame_free[movable].ravel() == 0)
    size = num_frame_columns + int(num_free.sum())
    return _Layout(frame_column, camera_column, free_params, num_free, size, held)
