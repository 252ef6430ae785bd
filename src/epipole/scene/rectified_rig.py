"""The two cameras of a rectified pair."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from epipole._checks import check_fields, checked
from epipole.errors import ConfigError

_NEAREST, _FARTHEST = 8.0, 800.0  # baselines


@dataclass(frozen=True, slots=True)
class RectifiedRig:
    """Two cameras side by side, with parallel axes and common rows."""

    focal_px: float
    cx: float
    """Principal point of the left camera."""
    cy: float
    baseline: float
    """In any unit, which is then that of depth."""
    principal_offset_px: float = 0.0
    """cx_right - cx_left (Middlebury's `doffs`)."""
    focal_sigma_px: float = 0.0
    """Standard deviations from calibration; zero if unknown."""
    baseline_sigma: float = 0.0
    principal_offset_sigma_px: float = 0.0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: a value is out of range or not finite.
        """
        check_fields(self)
        for name, value in (("focal_px", self.focal_px), ("baseline", self.baseline)):
            if not 0 < value < np.inf:
                hint = "; are left and right swapped?" if name == "baseline" and value < 0 else ""
                raise ConfigError(f"{name} must be positive and finite, got {value}{hint}")
        if not np.isfinite([self.cx, self.cy, self.principal_offset_px]).all():
            raise ConfigError("cx, cy and principal_offset_px must be finite numbers")
        sigmas = (self.focal_sigma_px, self.baseline_sigma, self.principal_offset_sigma_px)
        if not all(0 <= value < np.inf for value in sigmas):
            raise ConfigError(f"standard deviations of a rig must be finite and not negative, got {sigmas}")

    @property
    def K(self) -> Float64[np.ndarray, "3 3"]:
        """Intrinsics of the left camera."""
        return np.array([[self.focal_px, 0.0, self.cx], [0.0, self.focal_px, self.cy], [0.0, 0.0, 1.0]])

    @checked
    def calibration_sigma(self, disparity_px: Float[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
        """Disparity error, in pixels, equivalent to the errors of f, B and the principal points: Z = f B / (d + o)."""
        relative = (self.focal_sigma_px / self.focal_px) ** 2 + (self.baseline_sigma / self.baseline) ** 2
        shifted = disparity_px.astype(np.float64) + self.principal_offset_px
        return np.sqrt(relative * shifted**2 + self.principal_offset_sigma_px**2)

    def round_ranges(self) -> list[float]:
        """Depths 1, 2, 5, 10 ... from 8 to 800 baselines: the useful range."""
        exponent = int(np.floor(np.log10(_NEAREST * self.baseline)))
        steps = [m * 10.0**k for k in range(exponent, exponent + 4) for m in (1, 2, 5)]
        return [z for z in steps if _NEAREST * self.baseline <= z <= _FARTHEST * self.baseline]
