"""Options of structure-from-motion."""

from __future__ import annotations

from dataclasses import dataclass

from epipole.errors import ConfigError
from epipole.optim import Loss


@dataclass(frozen=True, kw_only=True)
class MapperConfig:
    """Options of incremental mapping."""

    start_min_inliers: int = 100
    """Matches that the first pair must have; halved twice when no pair has them."""
    start_angle_deg: float = 16.0
    """Median triangulation angle from which on a wider one does not make a better first pair."""
    start_trials: int = 30
    """First pairs tried at most."""
    max_error_px: float = 4.0
    """Observations with a larger reprojection error are dropped."""
    min_angle_deg: float = 1.5
    """Points seen under a narrower angle are dropped: their depth is not known."""
    resection_max_error_px: float = 12.0
    resection_min_inliers: int = 30
    resection_min_ratio: float = 0.25
    """Share of the points in sight that must agree with an image's place."""
    min_observations: int = 15
    """An image left with fewer is taken out again."""
    local_images: int = 6
    """Images adjusted together after each new one."""
    global_growth: float = 1.25
    """The whole model is adjusted each time it has grown by this factor."""
    final_rounds: int = 5
    """Adjust, filter and triangulate again at most so often in the end."""
    settled_share: float = 5e-4
    """Share of changed observations below which the model counts as settled."""
    loss: Loss = Loss.SOFT_L1
    """Robust loss of the global adjustment."""
    loss_scale_px: float = 1.0
    refine_focal: bool = True
    """Refine focal lengths that are not given as known."""
    refine_distortion: bool = True
    """Refine distortion that is not given as known."""
    max_models: int = 10
    """Components mapped at most when the pictures do not connect."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        if not self.max_error_px > 0 or not self.resection_max_error_px > 0:
            raise ConfigError("error bounds must be positive")
        if self.global_growth <= 1:
            raise ConfigError("global_growth must be greater than 1")
