"""Options for training radiance fields."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from epipole._checks import check_options
from epipole.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class SplatTraining:
    """Options for training Gaussians."""

    max_gaussians: int | None = None
    """Maximum number of Gaussians; None: derived from the training time and the images."""
    memory_gb: float | None = None
    """Memory limit for training, in gigabytes, which limits the number of Gaussians; None: no limit."""
    sh_degree: int = 3
    """Degree of the spherical harmonics, 0 to 3."""
    ssim_weight: float = 0.2
    """Weight of SSIM in the loss; L1 gets the rest."""
    antialiased: bool = False
    """Train with Mip-Splatting's filter, for images of very different resolutions."""
    start: Literal["points", "dense", "random"] = "points"
    """Initial Gaussians: at the model's points, also at stereo points (dense), or at random positions (random)."""
    start_from: Path | None = None
    """Initialize with the Gaussians of a PLY file or of an output folder of `splat` or `nerf`."""
    exposure: bool = False
    """Learn a color transform for each image, for cameras with automatic exposure or white balance."""
    refine_poses: bool = False
    """Also optimize the camera poses, if they are less accurate than a pixel."""
    depth_weight: float = 0.2
    """Weight of the depths of the model's points in the loss, relative to the image loss."""
    seed: int = 0
    """Random seed."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
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
    """Options for training a field that is rendered by ray marching."""

    kind: Literal["grid", "hash"] = "hash"
    """hash: a small network on hashed feature tables (Instant-NGP); grid: values in voxels (DVGO, Plenoxels)."""
    seed: int = 0
    """Random seed."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        check_options(self)
        if self.seed < 0:
            raise ConfigError(f"seed must not be negative, got {self.seed}")
