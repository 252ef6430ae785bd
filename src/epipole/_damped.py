"""Levenberg-Marquardt for small problems in Python; large ones (bundles, pose graphs) and kernels have loops of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

State = TypeVar("State")
LEAST_DAMPING, MOST_DAMPING = 1e-12, 1e8


def minimize(
    state: State,
    cost: Callable[[State], float],
    linearize: Callable[[State], Any],
    step: Callable[[State, Any, float], State | None],
    damping: float,
    tolerance: float,
    max_steps: int,
) -> State:
    """Minimum of a nonlinear least-squares cost (Levenberg 1944, Marquardt 1963).

    Args:
        state: where to start.
        cost: the cost of a state; a state of infinite or NaN cost is never taken.
        linearize: the normal equations at a state.
        step: the state that the damped normal equations lead to; None if they are singular.
        damping: the first one; times 10 after a step that raises the cost, divided by 10 after one that does not.
        tolerance: the search ends when a step lowers the cost by less than this fraction.
        max_steps: most steps that are taken.
    """
    lowest = cost(state)
    for _ in range(max_steps):
        equations, gain = linearize(state), np.nan
        while damping <= MOST_DAMPING:
            moved = step(state, equations, damping)
            after = np.inf if moved is None else cost(moved)
            if moved is not None and after <= lowest and after < np.inf:
                gain, state, lowest = lowest - after, moved, after
                damping = max(damping / 10.0, LEAST_DAMPING)
                break
            damping = max(10.0 * damping, LEAST_DAMPING)  # from zero, too
        if not gain > tolerance * lowest:  # NaN: no step lowers the cost
            break
    return state
