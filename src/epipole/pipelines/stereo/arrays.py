"""Stereo on arrays: disparities of a rectified pair."""

from __future__ import annotations

from typing import Any, Unpack

from epipole.config import options_of
from epipole.disparity_search import search
from epipole.pipelines.stereo.config import StereoConfig
from epipole.pipelines.stereo.options import StereoKeywords
from epipole.scene import DisparityMap


def match_stereo(
    left: Any, right: Any, config: StereoConfig | None = None, **options: Unpack[StereoKeywords]
) -> DisparityMap:
    """Disparities of a rectified pair of images, with standard deviations and reasons.

    Args:
        left: (h, w) or (h, w, 3), 8 or 16 bits; rows are epipolar lines.
        right: the same size.
        config: options; None for the defaults.
        **options: single options by name, which override `config`: `max_disparity_px=128`.

    Raises:
        ShapeError: the images have different sizes or unsupported types.
        ConfigError: an option is unknown, or the disparity range does not fit the images.
    """
    return search.match_stereo(left, right, options_of(StereoConfig, config, options, ["config"]))
