"""Bundle adjustment: poses, points and intrinsics, by Levenberg-Marquardt on the Schur complement."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float64

from epipole import _parallel
from epipole._checks import check_options, checked
from epipole.config import options_of
from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.optim.bundle_layout import BundleState, initial_state
from epipole.optim.bundle_problem import BundleProblem
from epipole.optim.bundle_system import BundleSystem, LinearSolver
from epipole.optim.losses import Loss

_LEAST_DAMPING, _FREE_DAMPING, _MOST_DAMPING = 1e-10, 1e-6, 1e12
_WEAK_GAUGE = 1e-5
"""Factor of the first two if only priors fix the gauge: a GPS fix has little weight against pixels."""
_LEAST_FACTOR = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleConfig:
    """Options of bundle adjustment."""

    loss: Loss = Loss.TRIVIAL
    loss_scale_px: float = 1.0
    max_iterations: int = 50
    function_tolerance: float = 1e-6
    """Stop when the relative decrease of the cost is smaller."""
    initial_damping: float = 1e-4
    solver: LinearSolver = LinearSolver.AUTO
    single_precision: bool = False
    """Store the eliminated points in single precision: half the memory. Cost and gradient stay in double
    precision, so the minimum is the same; only the steps are rounded."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        check_options(self)
        if self.max_iterations < 0 or not self.function_tolerance >= 0:
            raise ConfigError("max_iterations and function_tolerance must not be negative")
        if not (0 < self.loss_scale_px < 1e150 and 0 < self.initial_damping < math.inf):
            raise ConfigError("loss_scale_px and initial_damping must be positive, and below 1e150")


class StopReason(StrEnum):
    """Why an adjustment stopped."""

    CONVERGED = "the cost no longer falls"
    NO_STEP = "no step lowers the cost"
    MAX_ITERATIONS = "the number of iterations allowed"
    CANCELED = "canceled by the caller"
    NOTHING_TO_DO = "nothing may move"
    NO_OBSERVATIONS = "no observation can be used"


@dataclass(frozen=True, slots=True)
class BundleIteration:
    """One step, as reported to the progress callback."""

    iteration: int
    cost: float
    """Lowest cost so far, after the step."""
    damping: float
    is_accepted: bool
    num_products: int
    """Products with the reduced matrix; 0 if it was formed."""
    seconds: float
    """Since the start."""


@dataclass(frozen=True, slots=True, eq=False)
class BundleResult:
    """The adjusted quantities, and a record of the adjustment."""

    rig_from_world: Rigid3
    cam_from_rig: Rigid3
    camera_params: Float64[np.ndarray, "c 12"]
    points_in_world: Float64[np.ndarray, "p 3"]
    initial_cost: float
    final_cost: float
    num_iterations: int
    seconds: float
    reason: StopReason
    damping: float
    """Final damping, from which a resumed adjustment starts."""
    used_mask: Bool[np.ndarray, " k"]
    """False for unused observations: behind their camera at the start, or not finite."""
    history: tuple[BundleIteration, ...]
    solver: LinearSolver
    summary: str
    """Counts, and what the images do not determine; `str` of the result is the full report."""

    @property
    def converged(self) -> bool:
        """Whether the adjustment converged."""
        return self.reason in (StopReason.CONVERGED, StopReason.NO_STEP, StopReason.NOTHING_TO_DO)

    def __repr__(self) -> str:
        return (
            f"BundleResult(cost {self.initial_cost:.6g} -> {self.final_cost:.6g}, {self.num_iterations} iterations, "
            f"{self.seconds:.2f} s, {'converged' if self.converged else self.reason.value})"
        )

    def __str__(self) -> str:
        residuals = max(2 * int(self.used_mask.sum()), 1)
        per_observation = 1e6 * self.seconds / max(self.num_iterations * self.used_mask.sum(), 1)
        lines = [
            self.summary,
            f"cost        {self.initial_cost:.9g} -> {self.final_cost:.9g}",
            f"error       {(2 * self.initial_cost / residuals) ** 0.5:.4g} -> "
            f"{(2 * self.final_cost / residuals) ** 0.5:.4g} px (RMS of a coordinate, after the loss)",
            f"iterations  {self.num_iterations}, {self.seconds:.3f} s, {per_observation:.3f} us per observation",
            f"solver      {self.solver.value}",
            f"ended       {self.reason.value}",
        ]
        if self.history:
            lines.append(" step          cost   damping  products  seconds")
        for step in self.history:
            cost = f"{step.cost:13.6e}" if step.is_accepted else "     rejected"
            lines.append(
                f"{step.iteration:5d} {cost} {step.damping:9.1e} {step.num_products:9d} {step.seconds:8.3f}"
            )
        return "\n".join(lines)


@checked
def adjust_bundle(
    problem: BundleProblem,
    config: BundleConfig | None = None,
    progress: Callable[[BundleIteration], bool] | None = None,
) -> BundleResult:
    """Minimize half the sum of rho(|project - pixel|^2) (Triggs et al. 2000), plus the terms of the priors.

    Damping as in Nielsen (1999): it decreases by the gain ratio of actual to predicted decrease, and grows twice as fast
    with each rejected step. After each step every point is refined with the moved cameras fixed, which helps long chains of
    cameras. The cost never rises. Only what the problem holds constant is constant: see `with_fixed_gauge`. The result does
    not depend on the number of threads.

    Args:
        problem: the problem to solve; not modified.
        config: options.
        progress: called after every step; the adjustment stops if it returns False.

    Raises:
        ShapeError: the arrays of the problem do not match.
    """
    with _parallel.single_threaded_blas():
        return _adjust(problem, options_of(BundleConfig, config), progress)


def _adjust(
    problem: BundleProblem, config: BundleConfig, progress: Callable[[BundleIteration], bool] | None
) -> BundleResult:
    start = time.perf_counter()
    system = BundleSystem(
        problem, config.loss, config.loss_scale_px, config.solver, single_precision=config.single_precision
    )
    state = initial_state(problem)
    used = system.find_visible(state)
    cost = initial = system.cost(state)
    damping, growth, iteration = config.initial_damping, 2.0, 0
    constraint = _WEAK_GAUGE if problem.priors is not None and problem.priors.fixes_gauge else 1.0
    history: list[BundleIteration] = []
    reason = StopReason.MAX_ITERATIONS
    if not system.has_unknowns:
        reason = StopReason.NOTHING_TO_DO
    elif not used.any() or not np.isfinite(cost):
        reason = StopReason.NO_OBSERVATIONS
    while reason is StopReason.MAX_ITERATIONS and iteration < config.max_iterations:
        iteration += 1
        candidate, after, predicted, products = _try_step(system, state, damping)
        gain = (cost - after) / predicted if predicted > 0 else -1.0
        accepted, before = after <= cost and gain > 0, cost
        if accepted:
            state, cost = candidate, after
            damping *= max(_LEAST_FACTOR, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
            growth = 2.0
            # A step that is small because of the damping does not indicate convergence.
            if max(predicted, before - after) <= config.function_tolerance * before:
                if damping <= constraint * _FREE_DAMPING:
                    reason = StopReason.CONVERGED
                damping *= _LEAST_FACTOR
        else:
            if 0 <= predicted <= config.function_tolerance * 1e-3 * cost or damping > _MOST_DAMPING:
                reason = StopReason.NO_STEP
            damping, growth = damping * growth, growth * 2.0
        damping = max(damping, constraint * _LEAST_DAMPING)
        seconds = time.perf_counter() - start
        history.append(BundleIteration(iteration, cost, damping, accepted, products, seconds))
        if progress is not None and not progress(history[-1]):
            reason = StopReason.CANCELED
            break
    return BundleResult(
        rig_from_world=_motions(state.rig_from_world),
        cam_from_rig=_motions(state.cam_from_rig),
        camera_params=state.params,
        points_in_world=state.points.copy(),
        initial_cost=initial,
        final_cost=cost,
        num_iterations=iteration,
        seconds=time.perf_counter() - start,
        reason=reason,
        damping=damping,
        used_mask=used,
        history=tuple(history),
        solver=system.solver,
        summary=_summary(problem, used),
    )


@checked
def with_result(problem: BundleProblem, result: BundleResult) -> BundleProblem:
    """The problem with the adjusted quantities, to continue with `initial_damping=result.damping`."""
    return replace(
        problem,
        rig_from_world=result.rig_from_world,
        cam_from_rig=result.cam_from_rig,
        camera_params=result.camera_params,
        points_in_world=result.points_in_world,
    )


def _try_step(
    system: BundleSystem, state: BundleState, damping: float
) -> tuple[BundleState, float, float, int]:
    """The state after one damped Gauss-Newton step, its cost, the predicted decrease, and the number of products."""
    equations = system.linearize(state, damping)
    step, products = system.solve(equations)
    if step is None:
        return state, np.inf, -1.0, products
    moved, predicted = system.substitute_back(state, equations, step, damping)
    return moved, system.improve(moved, state), predicted, products


def _motions(rows: np.ndarray) -> Rigid3:
    return Rigid3(rows[:, :9].reshape(-1, 3, 3).copy(), rows[:, 9:].copy())


def _summary(problem: BundleProblem, used: np.ndarray) -> str:
    """Counts of observations used, and of weakly observed points and frames."""
    owner = np.repeat(np.arange(len(problem.point_free)), np.diff(problem.offsets))[used]
    by_point = np.bincount(owner, minlength=len(problem.point_free))
    by_frame = np.bincount(problem.frame[used], minlength=len(problem.frame_free))
    free_point, free_frame = problem.point_free > 0, problem.frame_free.any(axis=1)
    lines = [
        f"{int((by_frame > 0).sum())} frames, {int((problem.params_free.any(axis=1)).sum())} free cameras, "
        f"{int((by_point > 0).sum())} points, {int(used.sum())} observations"
    ]
    weak = {
        "observations ignored: behind their camera, or not finite": int((~used).sum()),
        "points observed once: their depth is undetermined": int((free_point & (by_point == 1)).sum()),
        "free points without observations": int((free_point & (by_point == 0)).sum()),
        "frames with fewer than three observations: their pose is undetermined": int(
            (free_frame & (by_frame > 0) & (by_frame < 3)).sum()
        ),
        "free frames without observations": int((free_frame & (by_frame == 0)).sum()),
    }
    lines += [f"{count} {what}" for what, count in weak.items() if count]
    return "\n".join(lines)
