"""Options of the disparity search."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from epipole._checks import check_options
from epipole.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class DisparityConfig:
    """Options of dense stereo matching."""

    min_disparity_px: int = 0
    """Smallest disparity searched; 0 becomes the disparity of infinity if the principal points differ."""
    max_disparity_px: int | None = None
    """Largest disparity searched; None: estimated from the images."""
    search: Literal["full", "coarse_to_fine"] = "full"
    """full: every disparity at every pixel; coarse_to_fine: only near the disparities found at half resolution."""
    method: Literal["sgm", "block"] = "sgm"
    """sgm: semi-global matching; block: block matching without a smoothness term."""
    block_px: int = 9
    """block: side of the blocks, odd, at most 15."""
    paths: Literal[4, 8] = 8
    """sgm: number of directions along which costs are summed; 4 is a fifth faster."""
    window: tuple[int, int] = (5, 5)
    """Width and height of the census window, odd."""
    brightness_cost: int = 0
    """Largest cost, in bits, of brightness differences (one bit per two gray levels); needs equal exposure."""
    small_penalty: int = 20
    """P1: penalty for a disparity change of one between neighbors, in bits of the census."""
    edge_penalty: float = 6.0
    """P2 = P1 (1 + edge_penalty exp(-brightness difference / edge_fade)): penalty for larger changes."""
    edge_fade: float = 10.0
    """Brightness difference, in gray levels, at which the extra penalty falls to 37 %."""
    left_right: Literal["accurate", "fast"] = "accurate"
    """Left-right check: accurate matches the right image separately; fast (half the time) reuses the sums."""
    max_left_right_px: float = 1.25
    """Pixels whose left and right disparities differ by more are marked as occluded."""
    min_margin: float = 0.0
    """Pixels are ambiguous unless the second lowest sum exceeds the lowest by this fraction."""
    max_sigma_px: float | None = None
    """Remove disparities with a larger standard deviation; None: keep all."""
    min_region_px: int = 40
    """Remove connected regions of similar disparity with fewer pixels as speckles."""
    median_px: Literal[0, 3, 5] = 5
    """Side of the median filter; 0: none."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        check_options(
            self,
            negative=("min_disparity_px", "max_disparity_px"),
            infinite=("edge_fade", "max_left_right_px", "max_sigma_px", "min_margin"),
        )
        if self.max_disparity_px is not None and self.max_disparity_px < self.min_disparity_px:
            raise ConfigError(
                f"max_disparity_px ({self.max_disparity_px}) must be at least min_disparity_px ({self.min_disparity_px})"
            )
        if (
            any(side < 1 or side % 2 == 0 for side in self.window)
            or not 2 < self.window[0] * self.window[1] <= 121
        ):
            raise ConfigError(f"window must have odd sides and 3 to 121 pixels, got {self.window}")
        if self.block_px < 1 or self.block_px % 2 == 0 or self.block_px > 15:
            raise ConfigError(f"block_px must be odd and at most 15, got {self.block_px}")
        if self.brightness_cost < 0:
            raise ConfigError("brightness_cost must not be negative")
        bits = self.window[0] * self.window[1] - 1 + self.brightness_cost
        largest = self.small_penalty * (1.0 + self.edge_penalty)
        if self.small_penalty < 1 or not self.edge_penalty >= 0 or not self.edge_fade > 0:
            raise ConfigError(
                "small_penalty must be at least 1, edge_penalty not negative and edge_fade positive, "
                f"got {self.small_penalty}, {self.edge_penalty} and {self.edge_fade}"
            )
        if bits + largest > 254:
            raise ConfigError(
                f"the sum of the cost's {bits} bits and the largest penalty {largest:g} must be at most 254"
            )
        if self.search == "coarse_to_fine" and self.left_right == "fast":
            raise ConfigError(
                "search coarse_to_fine needs left_right accurate: tiles do not give disparities of the right image"
            )
        if self.max_sigma_px is not None and not self.max_sigma_px > 0:
            raise ConfigError(f"max_sigma_px must be positive, got {self.max_sigma_px}")
        if not self.max_left_right_px > 0 or not self.min_margin >= 0 or self.min_region_px < 0:
            raise ConfigError("max_left_right_px must be positive, min_margin and min_region_px not negative")
