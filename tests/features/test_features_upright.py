"""Descriptors of upright windows: against the interpreter, against OpenCV, and what they do not depend on."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from epipole.errors import ConfigError, ShapeError
from epipole.features import _sift_kernels as kernels
from epipole.features import describe_upright, sift
from kernel_references import assert_same_as_python, record_calls, reference_of

CELLS, ANGLES = 4, 8


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    """Smooth noise of a middle contrast: gradients everywhere, the same look nowhere twice."""
    spots = gaussian_filter(np.random.default_rng(8).normal(size=(160, 200)), 6.0)
    return np.rint(128 + 30 * spots / spots.std()).clip(0, 255).astype(np.uint8)


@pytest.fixture
def pixels(rng: np.random.Generator) -> np.ndarray:
    """So far inside that no window reaches the rim."""
    return rng.uniform([60, 60], [140, 100], (20, 2))


def cosine(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    a, b = one.astype(float), other.astype(float)
    return (a * b).sum(axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)


@reference_of(kernels.describe_upright)
def test_the_kernel_is_its_source(image, monkeypatch):
    calls = record_calls(monkeypatch, sift, kernels.describe_upright)
    describe_upright(image, np.array([[90.3, 70.7], [0.0, 0.0], [199.0, 159.0], [-40.0, 500.0]]))
    describe_upright(image[:2, :3].copy(), np.array([[1.0, 1.0]]), 1.3)
    assert len(calls) == 2
    for *arguments, out in calls:
        # Half of a step may be rounded either way.
        _, (*_, found) = assert_same_as_python(kernels.describe_upright, *arguments, out, atol=1.0)
        assert found.any()


def test_opencv_sees_the_same_windows(image, pixels):
    found = describe_upright(image, pixels)
    spots = [cv2.KeyPoint(float(x), float(y), 10.0, 0.0) for x, y in pixels]
    _, theirs = cv2.SIFT_create().compute(image, spots)
    assert cosine(found, np.sqrt(theirs)).min() > 0.99
    assert np.median(cosine(np.roll(found, 1, axis=0), np.sqrt(theirs))) < 0.9  # other places look otherwise


def test_of_one_length_and_without_brightness_or_contrast(image, pixels):
    found = describe_upright(image, pixels)
    assert np.abs(np.linalg.norm(found.astype(float), axis=1) / 512 - 1).max() < 0.01
    flatter = np.rint(0.5 * image + 60.0).astype(np.uint8)
    assert cosine(describe_upright(flatter, pixels), found).min() > 0.995


def test_a_picture_moved_or_turned_by_half_moves_and_turns_them(image, pixels):
    found = describe_upright(image, pixels)
    moved = describe_upright(image[7:, 11:].copy(), pixels - [11.0, 7.0])
    assert np.abs(found.astype(int) - moved).max() <= 1
    rotated = describe_upright(np.ascontiguousarray(image[::-1, ::-1]), [199.0, 159.0] - pixels)
    expected = np.roll(found.reshape(-1, CELLS, CELLS, ANGLES)[:, ::-1, ::-1], ANGLES // 2, axis=3)
    assert np.abs(rotated.reshape(expected.shape).astype(int) - expected).max() <= 2
    assert cosine(found, rotated).max() < 0.95  # upright: a turned window is another thing


@pytest.mark.usefixtures("unchecked")
def test_nothing_to_describe_and_what_is_refused(image):
    assert describe_upright(image, np.zeros((0, 2))).shape == (0, 128)
    assert not describe_upright(image[:1].copy(), np.array([[5.0, 0.0]])).any()
    assert not describe_upright(np.full((50, 50), 90, np.uint8), np.array([[25.0, 25.0]])).any()
    with pytest.raises(ShapeError, match="finite"):
        describe_upright(image, np.array([[np.nan, 3.0]]))
    for wrong in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ConfigError, match="sigma_px"):
            describe_upright(image, np.array([[5.0, 5.0]]), wrong)
    rim = describe_upright(image, np.array([[1e30, -1e30], [199.0, 0.0]]))
    assert rim.shape == (2, 128)
