"""Adam for Gaussians (Kingma and Ba, ICLR 2015); each visible one is updated as soon as its gradient is gathered."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from epipole import _parallel
from epipole.fields.splat import _gradient_kernels as kernels
from epipole.fields.splat._simd_kernels import MOMENTUM, SQUARES
from epipole.fields.splat.rasterizer import Cloud, Tiles, View, ellipse_of_gaussian, gather_work, pieces_of


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
    grad2d: np.ndarray


class GaussianAdam:
    """Adam state of a cloud.

    Attributes:
        mean: first moments.
        square: second moments.
    """

    def __init__(self, cloud: Cloud) -> None:
        self.mean = Cloud(*(np.zeros_like(part) for part in cloud))
        self.square = Cloud(*(np.zeros_like(part) for part in cloud))

    def move(
        self, cloud: Cloud, view: View, tiles: Tiles, by_pair: np.ndarray, rates: Rates, count: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Update the visible Gaussians.

        Args:
            cloud: Gaussians, updated in place.
            view: camera that they were rendered from.
            tiles: tiles of the render.
            by_pair: from `sums_of_pairs`.
            rates: learning rates.
            count: number of this step, from 1.

        Returns:
            (ellipses,) norm of dL/d(image position), and (6,) derivative w.r.t. the pose.
        """
        unbias = 1.0 / (1.0 - np.array([MOMENTUM, SQUARES], np.float64) ** count)
        n, num_sh = len(cloud.means), cloud.sh.shape[1]
        ellipse = ellipse_of_gaussian(tiles, n)
        adam = AdamStep(
            self.mean,
            self.square,
            np.array(rates, np.float32),
            unbias.astype(np.float32),
            np.empty(len(tiles.gaussian), np.float32),
        )

        def move(start: int, stop: int, _: int) -> np.ndarray:
            by_pose = np.zeros(6)
            kernels.gather_and_move(
                view,
                cloud,
                ellipse,
                tiles.pair,
                by_pair,
                start,
                stop,
                adam,
                by_pose,
                gather_work(num_sh),
            )
            return by_pose

        by_poses = _parallel.map_chunks(move, n, pieces_of(n))
        return adam.grad2d, np.sum([np.zeros(6), *by_poses], axis=0)
