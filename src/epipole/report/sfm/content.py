"""What a report is made of: data only, gathered by the caller."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from epipole.scene import Reconstruction, ViewGraph


@dataclass(frozen=True, slots=True, eq=False)
class ImageRow:
    """One picture's line in the report."""

    name: str
    is_registered: bool
    component: int
    """0: the model shown; 1, 2, ...: another model; -1: none."""
    num_keypoints: int
    num_observations: int
    mean_error_px: float
    """Mean reprojection error of its observations; NaN where there are none."""
    reason: str = ""
    """Why the picture has no place, in words; empty when it has one."""


@dataclass(frozen=True, slots=True, eq=False)
class ReportContent:
    """Everything that the report tells."""

    title: str
    reconstruction: Reconstruction
    """The largest model."""
    view_graph: ViewGraph
    """Verified pairs; its image numbers are rows of `reconstruction.images`."""
    image_rows: tuple[ImageRow, ...]
    other_components: tuple[int, ...] = ()
    """Registered images of each further model."""
    camera_lines: tuple[str, ...] = ()
    timings: Mapping[str, float] = field(default_factory=dict)
    """Seconds of each stage, in order."""
    compile_seconds: float = 0.0
    """Part of the timings that compiling kernels took; 0 when they came from the cache."""
    warnings: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    version: str = ""
    thumbnails: Mapping[str, bytes] = field(default_factory=dict)
    """Image name to a small JPEG."""
    inliers: Mapping[str, Float[np.ndarray, "k 2"]] = field(default_factory=dict)
    """Image name to positions of features that see a point, as fractions of width and height."""
    scale_note: str = "unknown scale: pictures alone cannot tell"
    is_metric: bool = False
    """World coordinates are metres."""
    truth_errors: Mapping[str, str] = field(default_factory=dict)
    """What was compared with a known truth, and the outcome, in words with units."""

    @property
    def unit(self) -> str:
        """The unit of world coordinates."""
        return "m" if self.is_metric else "model units"
