"""Gaussians with view-dependent color: the model of 3D Gaussian Splatting."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from epipole._checks import Declared, check_fields, checked
from epipole.errors import ShapeError
from epipole.scene.notebook import table_html

NUM_SH = (1, 4, 9, 16)
"""Number of spherical harmonics up to degree 0, 1, 2 and 3."""
DC = 0.28209479177387814
"""The harmonic of degree 0: color = 0.5 + DC sh_0 + ..."""


@dataclass(frozen=True, slots=True, eq=False)
class GaussianCloud(Declared):
    """Kerbl, Kopanas, Leimkuehler and Drettakis, 3D Gaussian Splatting for Real-Time Radiance Field Rendering, 2023."""

    means_in_world: Float32[np.ndarray, "n 3"]
    """Relative to `origin_in_world`."""
    log_scales: Float32[np.ndarray, "n 3"]
    """Logarithms of the standard deviations along the Gaussian's own axes."""
    quats_wxyz: Float32[np.ndarray, "n 4"]
    """world_from_own, of any nonzero length."""
    opacity_logits: Float32[np.ndarray, " n"]
    """Opacity is 1 / (1 + exp(-logit))."""
    sh: Float32[np.ndarray, "n k 3"]
    """Coefficients of red, green and blue, in the order of 3DGS; k is 1, 4, 9 or 16."""
    origin_in_world: Float64[np.ndarray, " 3"] = field(default_factory=lambda: np.zeros(3))
    """Added to the means; nonzero if they are too far from the world's origin (such as UTM) for single precision."""

    def __post_init__(self) -> None:
        """Check the shapes.

        Raises:
            ShapeError: array sizes do not match, or the origin is not finite.
        """
        check_fields(self)
        if not np.isfinite(self.origin_in_world).all():
            raise ShapeError(f"origin_in_world must be finite, got {self.origin_in_world}")
        if self.sh.shape[1] not in NUM_SH:
            raise ShapeError(f"sh must have 1, 4, 9 or 16 coefficients, got {self.sh.shape[1]}")

    def __len__(self) -> int:
        return len(self.means_in_world)

    def __repr__(self) -> str:
        return f"GaussianCloud({len(self):,} Gaussians, harmonics of degree {self.sh_degree})"

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return NUM_SH.index(self.sh.shape[1])

    @property
    def centers_in_world(self) -> Float64[np.ndarray, "n 3"]:
        """The means in the world, in double precision."""
        return self.means_in_world.astype(np.float64) + self.origin_in_world

    @checked
    def relative_to(self, origin_in_world: Float64[np.ndarray, " 3"]) -> GaussianCloud:
        """The same Gaussians, with means relative to another origin."""
        means = (self.centers_in_world - origin_in_world).astype(np.float32)
        return replace(self, means_in_world=means, origin_in_world=origin_in_world)

    @checked
    def rows(self, chosen: Int64[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> GaussianCloud:
        """A subset of the Gaussians."""
        return GaussianCloud(
            self.means_in_world[chosen],
            self.log_scales[chosen],
            self.quats_wxyz[chosen],
            self.opacity_logits[chosen],
            self.sh[chosen],
            self.origin_in_world,
        )

    def _repr_html_(self) -> str:
        return table_html(
            "GaussianCloud", {"Gaussians": f"{len(self):,}", "harmonics of degree": self.sh_degree}
        )
