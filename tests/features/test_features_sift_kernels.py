"""Scale space, extrema and descriptors against SciPy and the interpreter."""

import numpy as np
import pytest
from scipy.ndimage import correlate1d, gaussian_filter

from epipole.config import FeatureConfig
from epipole.features import _scale_space_kernels as space
from epipole.features import _sift_kernels as kernels
from epipole.features import sift
from kernel_references import assert_same_as_python, record_calls, reference_of

# The exponentials of NumPy and of the compiler may differ in the last place, here of a float32.
SINGLE = {"rtol": 1e-6, "atol": 1e-6}
SHAPES = [(7, 11), (1, 1), (1, 6), (5, 1), (2, 2)]


def image(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    return rng.integers(0, 256, shape).astype(np.uint8)


@pytest.mark.parametrize("shape", SHAPES)
@reference_of(space.upsample, space.halve)
def test_doubled_and_halved(rng: np.random.Generator, shape: tuple[int, int]) -> None:
    gray, (height, width) = image(rng, shape), shape
    out = np.empty((2 * height, 2 * width), np.float32)
    _, (_, out) = assert_same_as_python(space.upsample, gray, out)
    y, x = (np.minimum(np.arange(2 * n) / 2, n - 1) for n in shape)
    y0, x0, y1, x1 = (
        np.floor(y).astype(int),
        np.floor(x).astype(int),
        np.ceil(y).astype(int),
        np.ceil(x).astype(int),
    )
    corners = [gray[np.ix_(r, c)] / 255.0 for r in (y0, y1) for c in (x0, x1)]
    np.testing.assert_allclose(out, np.mean(corners, axis=0), atol=1e-7)
    small = np.empty(shape, np.float32)
    _, (_, small) = assert_same_as_python(space.halve, out, small)
    np.testing.assert_array_equal(small, out[::2, ::2])
    odd = np.ones((2 * height + 1, 2 * width + 1), np.float32)
    assert_same_as_python(space.halve, odd, small)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("sigma", [0.3, 1.25, 5.0])
@reference_of(space.blur)
def test_blur(rng: np.random.Generator, shape: tuple[int, int], sigma: float) -> None:
    level, weights = rng.random(shape).astype(np.float32), sift._gaussian(sigma)
    _, (*_, out) = assert_same_as_python(space.blur, level, weights, np.empty_like(level), **SINGLE)
    line = np.concatenate([weights[:0:-1], weights]).astype(float)
    expected = level.astype(float)
    for axis in (0, 1):
        reach = len(weights) - 1
        period = np.pad(np.arange(shape[axis]), reach, mode="reflect" if shape[axis] > 1 else "edge")
        wide = np.take(expected, period, axis=axis)
        inner = np.arange(reach, reach + shape[axis])
        expected = np.take(correlate1d(wide, line, axis=axis, mode="nearest"), inner, axis=axis)
    np.testing.assert_allclose(out, expected, atol=1e-6)


@pytest.mark.parametrize("shape", [(24, 30), (16, 16)])
@reference_of(space.find_extrema, kernels.describe_all)
def test_features(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int]) -> None:
    extrema = record_calls(monkeypatch, sift, space.find_extrema)
    described = record_calls(monkeypatch, sift, kernels.describe_all)
    spots = gaussian_filter(rng.normal(size=shape), 1.5)
    gray = np.rint(255 * (spots - spots.min()) / np.ptp(spots)).astype(np.uint8)
    for sizes in (1, 3):
        sift.detect_sift(gray, FeatureConfig(contrast_threshold=0.001, domain_sizes=sizes))
    counts = []
    for *arguments, room in extrema:
        count, _ = assert_same_as_python(space.find_extrema, *arguments, np.zeros_like(room), **SINGLE)
        counts.append(count)
        # With too little room the count is the same, and nothing is written beyond it.
        less, _ = assert_same_as_python(space.find_extrema, *arguments, np.zeros_like(room[:1]), **SINGLE)
        assert less == count
    assert max(counts) > 1
    for levels, positions, sigma, pixel, sizes, columns, descriptors in described:
        for few in (0, 3):
            few_places, few_sigma = positions[:few].copy(), sigma[:few].copy()
            room = np.zeros_like(columns[: 4 * few]), np.zeros_like(descriptors[: 4 * few])
            count, _ = assert_same_as_python(
                kernels.describe_all, levels, few_places, few_sigma, pixel, sizes, *room, **SINGLE
            )
            assert (count > 0) == (len(few_places) > 0)
