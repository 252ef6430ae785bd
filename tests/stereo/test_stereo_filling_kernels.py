"""Smoothing along rows against dense least squares and the interpreter."""

import numpy as np
import pytest

from epipole.pipelines.stereo._filling_kernels import smooth_rows
from kernel_references import assert_same_as_python, reference_of


def smoothed(values: np.ndarray, links: np.ndarray, strength: float) -> np.ndarray:
    """Minimize sum (u - f)^2 + strength sum e_i (u_i - u_i+1)^2 by solving its normal equations."""
    steps = np.diff(np.eye(len(values)), axis=0)
    return np.linalg.solve(np.eye(len(values)) + strength * (steps.T * links[: len(steps)]) @ steps, values)


@pytest.mark.parametrize("shape", [(4, 9), (1, 1), (3, 2), (2, 1)])
@reference_of(smooth_rows)
def test_rows_are_smoothed(rng: np.random.Generator, shape: tuple[int, int]) -> None:
    weights, values, links = rng.random(shape), rng.normal(size=shape), rng.random(shape)
    weights[0, :] = 0.0
    links[:, ::2] = 0.0
    for strength in (0.0, 2.5, 1e9):
        stop = shape[0] - (shape[0] > 1)
        _, after = assert_same_as_python(smooth_rows, weights, values, links, strength, 0, stop)
        for y in range(stop):
            for before, found in ((weights, after[0]), (values, after[1])):
                expected = smoothed(before[y], links[y], strength)
                np.testing.assert_allclose(found[y], expected, rtol=1e-6, atol=1e-8)
        np.testing.assert_array_equal(after[1][stop:], values[stop:])
    assert_same_as_python(smooth_rows, weights, values, links, 1.0, 1, 1)
    values[-1, 0] = np.nan  # unknown stays unknown
    assert_same_as_python(smooth_rows, weights, values, links, 1.0, 0, shape[0])
