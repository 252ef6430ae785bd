"""Gaussians as the viewer shows them, and from where they are seen first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from epipole.errors import ShapeError
from epipole.scene.gaussian_cloud import GaussianCloud


@dataclass(frozen=True, slots=True, eq=False)
class SplatView:
    """What is shown."""

    cloud: GaussianCloud
    position: Float64[np.ndarray, " 3"]
    """Of the first view."""
    look_at: Float64[np.ndarray, " 3"]
    up: Float64[np.ndarray, " 3"]
    unit: str
    """What lengths are told in."""

    def __post_init__(self) -> None:
        """Check that there is something to see.

        Raises:
            ShapeError: there is no Gaussian.
        """
        if not len(self.cloud):
            raise ShapeError("there is no Gaussian to show")
