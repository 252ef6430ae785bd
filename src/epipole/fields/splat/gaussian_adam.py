"""Adam for Gaussians (Kingma and Ba, ICLR 2015); those that a view does not show stay as they are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from epipole import _parallel
from epipole.fields._adam_kernels import MOMENTUM, SQUARES, move_gaussians
from epipole.fields.splat.numba_backend import pieces_of
from epipole.fields.splat.rasterizer import Cloud, CloudGradient


class Rates(NamedTuple):
    """Learning rates; `sh` is for harmonics of degree 0, `higher_sh` for the rest."""

    means: float
    log_scales: float
    quats_wxyz: float
    logits: float
    sh: float
    higher_sh: float


class AdamStep(NamedTuple):
    """Adam's state and parameters, as the kernels read them."""

    mean: Cloud
    square: Cloud
    rates: np.ndarray
    unbias: np.ndarray


class GaussianAdam:
    """Adam state of a cloud.

    Attributes:
        mean: first moments.
        square: second moments.
    """

    def __init__(self, cloud: Cloud) -> None:
        self.mean = Cloud(*(np.zeros_like(part) for part in cloud))
        self.square = Cloud(*(np.zeros_like(part) for part in cloud))

    def step(
        self, cloud: Cloud, gradient: CloudGradient, is_visible: np.ndarray, rates: Rates, count: int
    ) -> None:
        """Update the visible Gaussians.

        Args:
            cloud: Gaussians, updated in place.
            gradient: derivatives of the loss.
            is_visible: (n,) Gaussians to update.
            rates: learning rates.
            count: number of this step, from 1.
        """
        unbias = 1.0 / (1.0 - np.array([MOMENTUM, SQUARES], np.float64) ** count)
        adam = AdamStep(self.mean, self.square, np.array(rates, np.float32), unbias.astype(np.float32))
        n = len(cloud.means)
        _parallel.map_chunks(
            lambda start, stop, _: move_gaussians(cloud, gradient, is_visible, start, stop, adam),
            n,
            pieces_of(n),
        )
