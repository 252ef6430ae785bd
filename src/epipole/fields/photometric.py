"""How like a picture is to another: L1 and SSIM with their derivative, and PSNR."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32

from epipole import _parallel
from epipole._declared import checked
from epipole.errors import ShapeError
from epipole.fields import _photometric_kernels as kernels

WINDOW_PX, SIGMA_PX = 11, 1.5
_WINDOW = cv2.getGaussianKernel(WINDOW_PX, SIGMA_PX).astype(np.float32)


class Likeness(NamedTuple):
    """A loss, its parts and its derivative."""

    loss: float
    """(1 - w) mean |x - y| + w (1 - SSIM)."""
    l1: float
    ssim: float
    by_picture: np.ndarray
    """(h, w, 3)"""


@checked
def likeness(
    picture: Float32[np.ndarray, "h w 3"], truth: Float32[np.ndarray, "h w 3"], ssim_weight: float = 0.2
) -> Likeness:
    """L1 and SSIM (Wang et al., IEEE TIP 2004) of pictures from 0 to 1, and the derivative of the loss by the first.

    Windows are Gaussian, 11 pixels wide, with zeros beyond the edges, as in 3D Gaussian Splatting. A blur is its own
    transpose: dL/dx = B(dL/dB(x)) + 2 x B(dL/dB(x x)) + y B(dL/dB(x y)).

    Args:
        picture: x.
        truth: y.
        ssim_weight: w, from 0 to 1.

    Raises:
        ShapeError: the pictures are empty.
    """
    if not picture.size:
        raise ShapeError("a picture without pixels is like nothing")
    n = picture.size
    sources = [picture, truth, picture * picture, truth * truth, picture * truth]
    blurred = _parallel.map_items(lambda k: _blurred(sources[k]), 5)
    total = kernels.ssim_terms(*(part.reshape(-1) for part in blurred), np.float32(-ssim_weight / n))
    back = [blurred[0], blurred[2], blurred[4]]
    by = _parallel.map_items(lambda k: _blurred(back[k]), 3)
    out = np.empty_like(picture)
    absolute = kernels.add_up(
        *(part.reshape(-1) for part in (picture, truth, *by)),
        np.float32((1.0 - ssim_weight) / n),
        out.reshape(-1),
    )
    l1, ssim = float(absolute) / n, float(total) / n
    return Likeness((1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - ssim), l1, ssim, out)


@checked
def psnr(picture: Float32[np.ndarray, "h w 3"], truth: Float32[np.ndarray, "h w 3"]) -> float:
    """Peak signal to noise, in dB, of pictures from 0 to 1; infinite for the same."""
    error = float(np.mean((np.clip(picture, 0.0, 1.0) - truth) ** 2, dtype=np.float64))
    return float(-10.0 * np.log10(error)) if error > 0 else float("inf")


def _blurred(picture: np.ndarray) -> np.ndarray:
    return cv2.sepFilter2D(picture, -1, _WINDOW, _WINDOW, borderType=cv2.BORDER_CONSTANT)
