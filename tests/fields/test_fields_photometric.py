"""L1 and SSIM against the formulas, and their derivative against differences."""

import numpy as np
import pytest
from scipy.ndimage import correlate1d

from epipole.errors import ShapeError
from epipole.fields import _photometric_kernels
from epipole.fields.photometric import SIGMA_PX, WINDOW_PX, photometric_loss, psnr
from kernel_references import reference_of


def plain_ssim(x, y):
    """Wang et al. 2004, equation 13, with zeros beyond the edges."""
    at = np.arange(WINDOW_PX) - WINDOW_PX // 2
    window = np.exp(-(at**2) / (2 * SIGMA_PX**2))
    window /= window.sum()

    def blur(a):
        for axis in (0, 1):
            a = correlate1d(a, window, axis=axis, mode="constant")
        return a

    mx, my = blur(x), blur(y)
    xx, yy, xy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return float(np.mean((2 * mx * my + c1) * (2 * xy + c2) / ((mx**2 + my**2 + c1) * (xx + yy + c2))))


def plain_loss(x, y, weight):
    x, y = x.astype(np.float64), y.astype(np.float64)
    return (1 - weight) * np.abs(x - y).mean() + weight * (1 - plain_ssim(x, y))


@pytest.fixture
def images(rng):
    y = rng.uniform(size=(23, 31, 3))
    return np.clip(y + 0.2 * rng.normal(size=y.shape), 0, 1).astype(np.float32), y.astype(np.float32)


@reference_of(_photometric_kernels.ssim_terms, _photometric_kernels.add_up)
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_loss_and_derivative(images, rng, weight):
    x, y = images
    found = photometric_loss(x, y, weight)
    assert found.loss == pytest.approx(plain_loss(x, y, weight), abs=2e-6)
    assert found.ssim == pytest.approx(plain_ssim(x.astype(float), y.astype(float)), abs=2e-6)
    assert found.l1 == pytest.approx(np.abs(x - y).mean(), rel=1e-5)
    for _ in range(12):
        i, j, k = (int(rng.integers(size)) for size in x.shape)
        ends = []
        for step in (1e-6, -1e-6):
            moved = x.astype(np.float64)
            moved[i, j, k] += step
            ends.append(plain_loss(moved, y, weight))
        assert found.by_image[i, j, k] == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=2e-3, abs=2e-7)


def test_the_same_picture(images):
    x, _ = images
    found = photometric_loss(x, x)
    assert found.l1 == 0.0 and found.ssim == pytest.approx(1.0, abs=1e-6) and psnr(x, x) == np.inf
    assert np.abs(found.by_image).max() < 1e-7


def test_psnr_is_that_of_the_mean_square(images):
    x, y = images
    assert psnr(x, y) == pytest.approx(10 * np.log10(1 / np.mean((x.astype(float) - y) ** 2)), abs=1e-5)


def test_an_empty_picture_is_refused():
    none = np.zeros((0, 4, 3), np.float32)
    with pytest.raises(ShapeError, match="must not be empty"):
        photometric_loss(none, none)
