"""Options of `epipole georeference`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from epipole._checks import check_options
from epipole.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class GeoreferenceConfig:
    """Options of `epipole georeference`; the defaults suit surveyed control points and usual GPS."""

    gcp: Path | None = None
    """File of control points: gcp_list.txt (OpenDroneMap) or ground_control_points.json (OpenSfM)."""
    check: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")] = ()
    """Name of a point that only checks the result, besides those named CHK-..."""
    gcp_sigma_m: float = 0.02
    """Standard deviation of the horizontal coordinates of control points."""
    gcp_height_sigma_m: float = 0.03
    """Standard deviation of the heights of control points."""
    mark_sigma_px: float = 1.0
    """Standard deviation of the pixels at which control points were marked."""
    use_gps: bool = True
    """Use the GPS positions of the images."""
    gps_sigma_m: float = 3.0
    """Standard deviation of GPS positions, horizontally, where images do not record it."""
    refine_cameras: bool = True
    """Refine focal length and distortion, unless the camera was given."""
    seed: int = 0
    """Random seed."""
    threads: int | None = None
    """Number of threads. Default: all cores."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range, or there is nothing to georeference with.
        """
        check_options(self)
        if not 0.01 <= self.mark_sigma_px <= 1e3:
            raise ConfigError(f"mark_sigma_px must be from 0.01 to 1000, got {self.mark_sigma_px}")
        for name in ("gcp_sigma_m", "gcp_height_sigma_m", "gps_sigma_m"):
            if not 1e-6 <= getattr(self, name) <= 1e6:
                raise ConfigError(f"{name} must be from 1e-6 to 1e6, got {getattr(self, name)}")
        if self.gcp is None and not self.use_gps:
            raise ConfigError("pass --gcp FILE with control points, or use GPS")
        if self.threads is not None and self.threads < 1:
            raise ConfigError(f"threads must be at least 1, got {self.threads}")
