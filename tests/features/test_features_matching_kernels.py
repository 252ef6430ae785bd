"""Best and second best against sorting whole matrices of similarities."""

import numpy as np
import pytest

from epipole.features import Features
from epipole.features import _byte_dot_kernels as byte_kernels
from epipole.features import _matching_kernels as kernels
from epipole.features import match as matching
from kernel_references import assert_same_as_python, reference_of

SHAPES = [(5, 70), (3, 64), (1, 1), (2, 5), (4, 0), (0, 33)]


def top_two(similarity: np.ndarray, nothing: float) -> tuple[np.ndarray, np.ndarray]:
    """The best and the second best of every row; `nothing` where there are fewer columns."""
    padded = np.pad(similarity, ((0, 0), (0, 2)), constant_values=nothing)
    return tuple(np.sort(padded, axis=1)[:, ::-1][:, :2].T)


@pytest.mark.parametrize("shape", SHAPES)
@reference_of(kernels.top_two, kernels.find_best_column)
def test_of_similarities(rng: np.random.Generator, shape: tuple[int, int]) -> None:
    n, m = shape
    for most in (4, 1 << 24):  # many ties; the whole range
        block = rng.integers(0, most, (n + 1, m)).astype(np.float32)  # a row more than is asked for
        seen = rng.integers(-1, most, m).astype(np.float32)
        out = np.empty(n, np.float32), np.empty(n, np.float32)
        _, (*_, best, second, column_best) = assert_same_as_python(kernels.top_two, block, n, *out, seen)
        expected = top_two(block[:n], -1.0)
        np.testing.assert_array_equal(best, expected[0])
        np.testing.assert_array_equal(second, expected[1])
        np.testing.assert_array_equal(column_best, np.vstack([block[:n], seen]).max(axis=0))

        wanted = rng.random(n) < 0.7
        column = np.full(n, -1, np.int32)
        _, (*_, column) = assert_same_as_python(kernels.find_best_column, block, n, best, wanted, column)
        if m:
            np.testing.assert_array_equal(column, np.where(wanted, block[:n].argmax(axis=1), -1))


@pytest.mark.parametrize("shape", [(6, 9), (1, 1), (3, 0), (0, 4), (2, 2)])
@reference_of(kernels.hamming_top_two)
def test_of_bits(rng: np.random.Generator, shape: tuple[int, int]) -> None:
    n, m = shape
    a, b = (rng.integers(0, 256, (k, 32)).astype(np.uint8) for k in shape)
    if n and m:
        a[0], b[0], b[-1] = 0, 255, a[-1]
    bits = np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2, dtype=np.int64)
    out = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64), np.full(m, 1 << 30, np.int64)
    _, (*_, column, best, second, column_best) = assert_same_as_python(
        kernels.hamming_top_two, a.view(np.uint64), b.view(np.uint64), *out
    )
    expected = top_two(-bits, -(1 << 30))
    np.testing.assert_array_equal(best, -expected[0])
    np.testing.assert_array_equal(second, -expected[1])
    np.testing.assert_array_equal(column_best, np.vstack([bits, out[3]]).min(axis=0))
    np.testing.assert_array_equal(column, bits.argmin(axis=1) if m else -1)


@pytest.mark.parametrize("sizes", [(12, 30), (1, 1), (0, 3)])
@pytest.mark.parametrize("slope", [0.0, 0.4, 30.0])
@reference_of(kernels.guided_top_two)
def test_along_lines(rng: np.random.Generator, sizes: tuple[int, int], slope: float) -> None:
    n, m = sizes
    pixels1, pixels2 = (rng.uniform(-3, 200, (k, 2)) for k in sizes)
    descriptors1, descriptors2 = (rng.integers(0, 3, (k, 128)).astype(np.uint8) for k in sizes)
    descriptors2[m // 2 :] = descriptors2[: m - m // 2]
    ones = np.ones(m, np.float32)
    features2 = Features(pixels2.astype(np.float32), ones, ones, descriptors2)
    cells = matching._cells(features2, 0), matching._cells(features2, 1)
    # The line of (x, y) is slope (x2 - x) = y2 - y; of the last, none.
    f = np.array([[0.0, 0.0, slope], [0.0, 0.0, -1.0], [-slope, 1.0, 0.0]])
    band = 12.0
    out = *(np.empty(n, np.int32) for _ in range(3)), np.full(m, -1, np.int32)
    arguments = (pixels1, descriptors1, *cells, f, band, 32.0, 8.0, *out)
    _, (*_, column, best, second, column_best) = assert_same_as_python(kernels.guided_top_two, *arguments)
    line = np.hstack([pixels1, np.ones((n, 1))]) @ f.T
    distance = line @ np.hstack([features2.pixels, np.ones((m, 1))]).T / np.hypot(line[:, :1], line[:, 1:2])
    similarity = np.where(np.abs(distance) <= band, descriptors1.astype(int) @ descriptors2.T.astype(int), -1)
    expected = top_two(similarity, -1)
    np.testing.assert_array_equal(best, expected[0])
    np.testing.assert_array_equal(second, expected[1])
    np.testing.assert_array_equal(column_best, similarity.max(axis=0, initial=-1))
    found = np.flatnonzero(column >= 0)
    np.testing.assert_array_equal(similarity[found, column[found]], best[found])
    no_lines = (*arguments[:4], np.zeros((3, 3)), *arguments[5:])
    _, (*_, column, _, _, _) = assert_same_as_python(kernels.guided_top_two, *no_lines)
    assert (column == -1).all()


@pytest.mark.parametrize("sizes", [(12, 60), (1, 1), (0, 3)])
@reference_of(kernels.nearby_top_two)
def test_near_pixels(rng: np.random.Generator, sizes: tuple[int, int]) -> None:
    n, m = sizes
    wanted, pixels = (rng.uniform(-10, 90, (k, 2)) for k in sizes)
    descriptors1, descriptors2 = (rng.integers(0, 3, (k, 128)).astype(np.uint8) for k in sizes)
    wanted[:1] = -np.inf
    ones = np.ones(m, np.float32)
    features = Features(pixels.astype(np.float32), ones, ones, descriptors2)
    radius = 25.0
    out = *(np.empty(n, np.int32) for _ in range(3)), np.full(m, -1, np.int32)
    arguments = (wanted, descriptors1, matching._cells(features, 0), 32.0, 8.0, radius, *out)
    _, (*_, column, best, second, column_best) = assert_same_as_python(kernels.nearby_top_two, *arguments)
    distance = np.linalg.norm(wanted[:, None] - features.pixels.astype(np.float64), axis=2)
    similarity = np.where(distance <= radius, descriptors1.astype(int) @ descriptors2.T.astype(int), -1)
    expected = top_two(similarity, -1)
    np.testing.assert_array_equal(best, expected[0])
    np.testing.assert_array_equal(second, expected[1])
    np.testing.assert_array_equal(column_best, similarity.max(axis=0, initial=-1))
    found = np.flatnonzero(column >= 0)
    np.testing.assert_array_equal(similarity[found, column[found]], best[found])


@reference_of(byte_kernels.most_squared_length)
def test_lengths(rng: np.random.Generator) -> None:
    for descriptors in (rng.integers(0, 256, (7, 128)), np.full((1, 128), 255), np.empty((0, 128))):
        expected = (descriptors.astype(np.int64) ** 2).sum(axis=1).max(initial=0)
        found, _ = assert_same_as_python(byte_kernels.most_squared_length, descriptors.astype(np.uint8))
        assert found == expected


def padded(descriptors: np.ndarray, multiple: int) -> np.ndarray:
    return np.pad(descriptors, ((0, -len(descriptors) % multiple), (0, 0))).astype(int)


@pytest.mark.skipif(byte_kernels.LANES == 0, reason="this processor has no products of whole numbers")
@pytest.mark.parametrize("sizes", [(11, 70), (8, 32), (1, 1), (0, 5), (3, 0)])
@reference_of(byte_kernels.pack_rows, byte_kernels.pack_columns, byte_kernels.byte_top_two)
def test_of_bytes(rng: np.random.Generator, sizes: tuple[int, int]) -> None:
    a, b = (rng.integers(0, 40, (k, 128)).astype(np.uint8) for k in sizes)
    a[: len(a) // 3], b[len(b) // 2 :] = 0, b[: len(b) - len(b) // 2]  # no similarity at all; exact ties
    wide_a, wide_b = padded(a, byte_kernels.ROWS), padded(b, byte_kernels.COLUMNS)
    rows = np.empty((len(wide_a) // byte_kernels.ROWS, byte_kernels.ROWS, 128), byte_kernels.ROW_TYPE)
    tiles = len(wide_b) // byte_kernels.COLUMNS
    layout = (tiles, byte_kernels.STEPS, byte_kernels.COLUMNS, byte_kernels.GROUP)
    columns = np.empty(layout, byte_kernels.COLUMN_TYPE)
    bias = np.empty((tiles, byte_kernels.COLUMNS), np.uint32)
    _, (_, rows) = assert_same_as_python(byte_kernels.pack_rows, a, rows)
    np.testing.assert_array_equal(rows.reshape(-1, 128), wide_a - byte_kernels.SHIFT)
    _, (_, columns, bias) = assert_same_as_python(byte_kernels.pack_columns, b, columns, bias)
    np.testing.assert_array_equal(columns.swapaxes(1, 2).reshape(-1, 128), wide_b)
    np.testing.assert_array_equal(bias.ravel(), byte_kernels.SHIFT * wide_b.sum(axis=1))

    best, second = np.zeros((2, len(wide_a)), np.uint32)
    column, column_best = np.zeros(len(wide_a), np.int32), np.zeros(bias.shape, np.uint32)
    byte_kernels.byte_top_two(rows, columns, bias, best, second, column, column_best)
    similarity = wide_a @ wide_b.T
    expected = top_two(similarity, 0)
    np.testing.assert_array_equal(best, expected[0])
    np.testing.assert_array_equal(second, expected[1])
    np.testing.assert_array_equal(column_best.ravel(), similarity.max(axis=0, initial=0))
    if tiles:
        np.testing.assert_array_equal(column, similarity.argmax(axis=1))
