"""Rows as vectors: each function is the loop that it stands for, in both precisions and every width."""

import numpy as np
import pytest

from epipole._jit import kernel
from epipole._simd_kernels import (
    add_product,
    add_rows,
    add_two_rows,
    scale_row,
    set_rows,
    set_two_rows,
    subtract_product,
)


@kernel
def combine(target, x, y, z, lanes):
    add_rows(target[0], 2.0, x, -3.0, y, 0.5, z, lanes)
    add_two_rows(target[1], 2.0, x, -3.0, y, lanes)
    set_rows(target[2], 2.0, x, -3.0, y, 0.5, target[2], lanes)
    add_product(target[3], x, y, lanes)
    scale_row(target[4], 2.0, target[4], lanes)
    set_two_rows(target[5], 2.0, x, -3.0, target[5], lanes)


@pytest.mark.parametrize("width", [8, 12, 16, 20])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_rows_are_combined(rng, width, dtype):
    x, y, z = rng.normal(size=(3, width)).astype(dtype)
    target = rng.normal(size=(6, width + 3)).astype(dtype)  # what lies beyond the lanes stays
    before = target.astype(np.float64)
    combine(target, x, y, z, (0,) * width)
    expected, own = before.copy(), slice(0, width)
    expected[0, own] += 2.0 * x - 3.0 * y.astype(np.float64) + 0.5 * z
    expected[1, own] += 2.0 * x - 3.0 * y.astype(np.float64)
    expected[2, own] = 2.0 * x - 3.0 * y.astype(np.float64) + 0.5 * before[2, own]
    expected[3, own] += x.astype(np.float64) * y
    expected[4, own] *= 2.0
    expected[5, own] = 2.0 * x - 3.0 * before[5, own]
    np.testing.assert_allclose(target, expected, rtol=2e-6 if dtype is np.float32 else 1e-14, atol=1e-6)
    np.testing.assert_array_equal(target[:, width:], before[:, width:].astype(dtype))


@kernel
def subtract(block, x, y, height, lanes):
    subtract_product(block, x, y, height, lanes)


@pytest.mark.parametrize("width", [8, 12, 16, 20])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("height", [0, 1, 6, 8])
def test_a_product_of_three_rows_is_subtracted(rng, width, dtype, height):
    x, y = rng.normal(size=(2, 3, width)).astype(dtype)
    block = rng.normal(size=(width, width))
    expected = block.copy()
    expected[:height] -= x[:, :height].T.astype(np.float64) @ y.astype(np.float64)
    subtract(block, x, y, height, (0,) * width)
    np.testing.assert_allclose(block, expected, rtol=1e-13, atol=1e-14)
