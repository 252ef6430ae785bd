"""Every option of the system, defined once; the command line is generated from these classes.

They stand in one light module, because rooms import compiled kernels and `epipole --help` must not wait for them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeVar

from epipole.errors import ConfigError

Options = TypeVar("Options")


def options_of(kind: type[Options], given: Options | None) -> Options:
    """What was given, or the defaults for None.

    Raises:
        ConfigError: something else was given, a dict for one.
    """
    if given is None:
        return kind()
    if not isinstance(given, kind):
        hint = f"; {kind.__name__}(**it) makes one" if isinstance(given, dict) else ""
        raise ConfigError(f"options must be a {kind.__name__}, not a {type(given).__name__}{hint}")
    return given


@dataclass(frozen=True, kw_only=True)
class FeatureConfig:
    """Options of feature detection."""

    kind: Literal["sift", "orb"] = "sift"
    """SIFT, or ORB where speed matters more than reach."""
    max_features: int = 8192
    """Features kept per image, the largest first."""
    max_size_px: int = 3200
    """Larger pictures are reduced to this longer side for detection."""
    contrast_threshold: float = 0.02
    """SIFT: fainter blobs are ignored (OpenCV's unit)."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        if self.max_features < 1 or self.max_size_px < 16:
            raise ConfigError("max_features must be at least 1 and max_size_px at least 16")


@dataclass(frozen=True, kw_only=True)
class MatchConfig:
    """Options of matching."""

    max_ratio: float = 0.8
    """Lowe's ratio: the nearest descriptor must be nearer than this times the second nearest."""
    max_distance: float = 0.7
    """SIFT: largest angle between matching descriptors, in radians."""
    max_bits: int = 64
    """ORB: largest Hamming distance of a match."""
    preemptive_features: int = 2048
    """SIFT: of both pictures so many features at most, the largest third, are matched first (preemptive matching); the
    others then along their epipolar lines. 0: all with all."""
    preemptive_min_matches: int = 12
    """Fewer preemptive matches mean that the pictures do not overlap."""
    preemptive_min_inliers: int = 30
    """Fewer preemptive inliers give no epipolar geometry: all features are then compared with all."""
    band_px: float = 3.0
    """Guided matches lie within so many pixels of their epipolar line."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        if not 0 < self.max_ratio <= 1:
            raise ConfigError(f"max_ratio must be in (0, 1], got {self.max_ratio}")
        if self.preemptive_features < 0 or not self.band_px > 0:
            raise ConfigError("preemptive_features must not be negative and band_px must be positive")


@dataclass(frozen=True, kw_only=True)
class RansacConfig:
    """Options of the robust loop."""

    max_error_px: float = 4.0
    """Matches with a larger residual are outliers."""
    confidence: float = 0.9999
    """Probability of having drawn a sample of inliers before stopping."""
    min_iterations: int = 50
    max_iterations: int = 10_000
    min_inliers: int = 15
    """Fewer inliers count as failure."""
    min_inlier_ratio: float = 0.0
    """A smaller share of inliers is not searched for, though taken when met: saves time where it would be a failure."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        if not self.max_error_px > 0:
            raise ConfigError(f"max_error_px must be positive, got {self.max_error_px}")
        if not 0 < self.confidence < 1:
            raise ConfigError(f"confidence must be between 0 and 1, got {self.confidence}")
        if not 0 <= self.min_inlier_ratio <= 1:
            raise ConfigError(f"min_inlier_ratio must be between 0 and 1, got {self.min_inlier_ratio}")
        if min(self.min_iterations, self.max_iterations, self.min_inliers) < 1:
            raise ConfigError("min_iterations, max_iterations and min_inliers must be at least 1")
