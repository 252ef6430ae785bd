"""The damped least-squares loop: known minima, and what it must never do."""

import numpy as np
import pytest

from epipole._damped import minimize


def rosenbrock(x: np.ndarray) -> np.ndarray:
    return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])


def solve(residuals, jacobian, start, **options):
    def step(x, equations, damping):
        normal, gradient = equations
        return x - np.linalg.solve(normal + damping * np.eye(len(x)), gradient)

    return minimize(
        start,
        lambda x: float(residuals(x) @ residuals(x)),
        lambda x: (jacobian(x).T @ jacobian(x), jacobian(x).T @ residuals(x)),
        step,
        **{"damping": 1e-3, "tolerance": 1e-14, "max_steps": 100, **options},
    )


def test_the_minimum_of_rosenbrock_s_function_is_found() -> None:
    found = solve(rosenbrock, lambda x: np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]]), np.array([-1.2, 1.0]))
    np.testing.assert_allclose(found, 1.0, atol=1e-8)


def test_a_linear_problem_takes_one_step_without_damping() -> None:
    matrix, right = np.array([[2.0, 1.0], [1.0, 3.0], [0.5, -1.0]]), np.array([1.0, 2.0, 3.0])
    found = solve(lambda x: matrix @ x - right, lambda x: matrix, np.zeros(2), damping=0.0, max_steps=1)
    np.testing.assert_allclose(found, np.linalg.lstsq(matrix, right, rcond=None)[0], atol=1e-12)


@pytest.mark.parametrize("damping", [0.0, 1e-6])
@pytest.mark.parametrize("after", [2.0, np.nan, np.inf, None])
def test_a_step_that_does_not_lower_the_cost_is_never_taken(after: float | None, damping: float) -> None:
    moves = [] if after is None else [after]
    found = minimize(
        0.0,
        lambda state: 1.0 if state == 0.0 else state,
        lambda state: None,
        lambda state, equations, damping: moves[0] if moves else None,
        damping=damping,
        tolerance=1e-6,
        max_steps=10,
    )
    assert found == 0.0
