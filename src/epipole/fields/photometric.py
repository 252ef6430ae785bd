"""Image similarity: L1 and SSIM with their derivative, and PSNR."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32

from epipole import _parallel
from epipole._checks import check_fraction, checked
from epipole.errors import ShapeError
from epipole.fields import _photometric_kernels as kernels

WINDOW_PX, SIGMA_PX = 11, 1.5
TOGETHER = 32_768
"""Elements processed as one task."""
_WINDOW = cv2.getGaussianKernel(WINDOW_PX, SIGMA_PX).astype(np.float32)


class PhotometricLoss(NamedTuple):
    """A loss, its parts and its derivative."""

    loss: float
    """(1 - w) mean |x - y| + w (1 - SSIM)."""
    l1: float
    ssim: float
    by_image: np.ndarray
    """(h, w, 3) derivative of the loss w.r.t. the image."""


@checked
def photometric_loss(
    image: Float32[np.ndarray, "h w 3"], truth: Float32[np.ndarray, "h w 3"], ssim_weight: float = 0.2
) -> PhotometricLoss:
    """L1 and SSIM (Wang et al., IEEE TIP 2004) of images from 0 to 1, with the derivative w.r.t. the first one.

    The SSIM window is Gaussian, 11 pixels wide, with zero padding, as in 3D Gaussian Splatting. The blur B is its own
    transpose, so dL/dx = B(dL/dB(x)) + 2 x B(dL/dB(x x)) + y B(dL/dB(x y)).

    Args:
        image: x.
        truth: y.
        ssim_weight: w, from 0 to 1.

    Raises:
        ShapeError: the images are empty.
        ConfigError: ssim_weight is not from 0 to 1.
    """
    check_fraction(ssim_weight, "ssim_weight")
    if not image.size:
        raise ShapeError("image and truth must not be empty")
    n = image.size
    pairs = ((image, None), (truth, None), (image, image), (truth, truth), (image, truth))
    blurred = _parallel.map_items(lambda k: _blurred(*pairs[k]), 5)
    flat, scale = [part.reshape(-1) for part in blurred], np.float32(-ssim_weight / n)
    totals = _parallel.map_chunks(
        lambda a, b, _: kernels.ssim_terms(*flat, a, b, scale), n, -(-n // TOGETHER)
    )
    back = [blurred[0], blurred[2], blurred[4]]
    by = _parallel.map_items(lambda k: _blurred(back[k]), 3)
    out, fraction = np.empty_like(image), np.float32((1.0 - ssim_weight) / n)
    flat = [part.reshape(-1) for part in (np.ascontiguousarray(image), np.ascontiguousarray(truth), *by)]
    absolutes = _parallel.map_chunks(
        lambda a, b, _: kernels.add_up(*flat, a, b, fraction, out.reshape(-1)), n, -(-n // TOGETHER)
    )
    absolute, total = sum(absolutes), sum(totals)
    l1, ssim = float(absolute) / n, float(total) / n
    return PhotometricLoss((1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - ssim), l1, ssim, out)


@checked
def psnr(image: Float32[np.ndarray, "h w 3"], truth: Float32[np.ndarray, "h w 3"]) -> float:
    """Peak signal-to-noise ratio in dB of images from 0 to 1; infinite if they are equal.

    Raises:
        ShapeError: the images are empty or not finite.
    """
    if not image.size or not (np.isfinite(image).all() and np.isfinite(truth).all()):
        raise ShapeError("image and truth must not be empty and must be finite")
    error = float(np.mean((np.clip(image, 0.0, 1.0) - truth) ** 2, dtype=np.float64))
    return float(-10.0 * np.log10(error)) if error > 0 else float("inf")


def _blurred(image: np.ndarray, other: np.ndarray | None = None) -> np.ndarray:
    """Blurred image, or blurred product of two images."""
    source = image if other is None else image * other
    return cv2.sepFilter2D(source, -1, _WINDOW, _WINDOW, borderType=cv2.BORDER_CONSTANT)
