"""Options of training fields."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from epipole._declared import check_options
from epipole.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class SplatTraining:
    """How Gaussians are trained."""

    max_gaussians: int | None = None
    """Gaussians at the end: time and memory grow with them; None: as many as the time bears."""
    memory_gb: float | None = None
    """Memory that the training may take: there are no more Gaussians than fit in it; None: no limit."""
    sh_degree: int = 3
    """Degree of the spherical harmonics, 0 to 3."""
    ssim_weight: float = 0.2
    """Share of SSIM in the loss; the rest is L1."""
    antialiased: bool = False
    """Train with Mip-Splatting's filter: for images of many sizes."""
    start: Literal["points", "dense", "random"] = "points"
    """Where the first Gaussians are: at the model's points (points), also at those that stereo of neighbouring views finds where
    the model has few (dense), or where the cameras look (random, and where there are no points)."""
    start_from: Path | None = None
    """Begin with these Gaussians: a PLY file of some, or an output folder of `splat` or `nerf`."""
    exposure: bool = False
    """Learn a map of colours for each image: where cameras chose exposure and white balance anew."""
    refine_poses: bool = False
    """Move the cameras, too: where they are less sure than to a pixel."""
    depth_weight: float = 0.2
    """Weight of the depths of the model's points in the loss, against the images' 1."""
    seed: int = 0
    """Of all that is drawn."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_options(self)
        if self.max_gaussians is not None and not 1 <= self.max_gaussians <= 100_000_000:
            raise ConfigError(f"max_gaussians must be from 1 to 100 million, got {self.max_gaussians}")
        if self.memory_gb is not None and not 0 < self.memory_gb < 1e6:
            raise ConfigError(f"memory_gb must be positive, got {self.memory_gb}")
        if not 0 <= self.sh_degree <= 3:
            raise ConfigError(f"sh_degree must be 0, 1, 2 or 3, got {self.sh_degree}")
        if not (math.isfinite(self.ssim_weight) and 0 <= self.ssim_weight <= 1):
            raise ConfigError(f"ssim_weight must be from 0 to 1, got {self.ssim_weight}")
        if not (math.isfinite(self.depth_weight) and 0 <= self.depth_weight <= 100):
            raise ConfigError(f"depth_weight must be from 0 to 100, got {self.depth_weight}")
        if self.seed < 0:
            raise ConfigError(f"seed must not be negative, got {self.seed}")


@dataclass(frozen=True, kw_only=True)
class NerfTraining:
    """How a field that is marched through is trained."""

    kind: Literal["grid", "hash"] = "hash"
    """hash: a small network that reads hashed tables (as Instant-NGP); grid: densities and harmonics in voxels (as DVGO and Plenoxels)."""
    seed: int = 0
    """Of all that is drawn."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_options(self)
        if self.seed < 0:
            raise ConfigError(f"seed must not be negative, got {self.seed}")
