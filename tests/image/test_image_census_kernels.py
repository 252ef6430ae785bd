"""The census against its definition, window by window."""

import numpy as np
import pytest

from epipole.image._census_kernels import census_rows
from kernel_references import assert_same_as_python, reference_of


def census_by_windows(image: np.ndarray, window: tuple[int, int]) -> np.ndarray:
    width, height = window
    padded = np.pad(image, ((height // 2,) * 2, (width // 2,) * 2), mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(padded, (height, width)).reshape(*image.shape, -1)
    darker = np.delete(around, width * height // 2, axis=2) < image[:, :, None]
    return np.packbits(darker, axis=2, bitorder="little")


@pytest.mark.parametrize("shape", [(9, 14), (1, 1), (1, 7), (6, 1), (3, 2)])
@pytest.mark.parametrize("window", [(7, 7), (9, 7), (3, 3)])
@reference_of(census_rows)
def test_census(rng: np.random.Generator, shape: tuple[int, int], window: tuple[int, int]) -> None:
    for most in (3, 65536):  # many ties; the whole range
        image = rng.integers(0, most, shape).astype(np.uint16)
        expected = census_by_windows(image, window)
        out = np.zeros_like(expected)
        half = window[0] // 2, window[1] // 2
        _, (*_, out) = assert_same_as_python(census_rows, image, *half, 0, shape[0] // 2, out)
        assert not out[shape[0] // 2 :].any()
        _, (*_, out) = assert_same_as_python(census_rows, image, *half, shape[0] // 2, shape[0], out)
        np.testing.assert_array_equal(out, expected)
