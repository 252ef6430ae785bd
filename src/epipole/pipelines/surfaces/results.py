"""Figures of a surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from epipole.errors import DegenerateGeometryError
from epipole.pipelines.surfaces.depth_stage import depth_in
from epipole.pipelines.surfaces.inputs import SurfaceInputs
from epipole.runs import Run, Unit
from epipole.scene.view_depth import DepthReason


@dataclass(frozen=True, slots=True, eq=False)
class DepthFigures:
    """Figures of the depth of each view."""

    names: tuple[str, ...]
    density: np.ndarray
    """(n,) fraction of pixels with a depth."""
    relative_sigma: np.ndarray
    """(n,) median standard deviation relative to the depth; NaN without any."""
    reasons: np.ndarray
    """(n, 8) fraction of pixels by reason."""

    def require_depth(self) -> None:
        """Check that some pixel has a depth.

        Raises:
            DegenerateGeometryError: none has; the message has the most frequent reason.
        """
        if not self.density.any():
            fractions = self.reasons.mean(axis=0)
            reason = DepthReason(int(np.argmax(fractions)))
            words = reason.name.lower().replace("_", " ")
            raise DegenerateGeometryError(
                f"no pixel has a depth, so there is no surface; the most frequent reason is: {words} ({100 * fractions[reason]:.0f} % of the pixels)"
            )


def depth_figures(inputs: SurfaceInputs, depths: Mapping[int, Unit]) -> DepthFigures:
    """Read the depth of each view, and summarize it."""
    rows = []
    for k, unit in depths.items():
        found = depth_in(unit.path)
        known = found.reason == DepthReason.OK
        sigma = float(np.median(found.sigma[known] / found.depth[known])) if known.any() else np.nan
        reasons = np.bincount(found.reason.ravel(), minlength=len(DepthReason)) / found.reason.size
        rows.append((inputs.views[k].name, found.density, sigma, reasons))
    return DepthFigures(
        tuple(row[0] for row in rows), *(np.array([row[k] for row in rows]) for k in (1, 2, 3))
    )


def summary_of(
    inputs: SurfaceInputs, figures: DepthFigures, facts: Mapping[str, Any], run: Run
) -> dict[str, Any]:
    """Contents of `summary.json`."""
    reasons = figures.reasons.mean(axis=0)
    sigma = figures.relative_sigma[np.isfinite(figures.relative_sigma)]
    return {
        "num_images": len(inputs.views),
        "num_views": len(figures.names),
        "density": float(figures.density.mean()),
        "relative_sigma": float(np.median(sigma)) if len(sigma) else None,
        "reasons": {reason.name.lower(): float(reasons[reason]) for reason in DepthReason},
        **facts,
        "views": {
            name: {"density": float(density), "relative_sigma": None if np.isnan(sigma) else float(sigma)}
            for name, density, sigma in zip(figures.names, figures.density, figures.relative_sigma)
        },
        "timings_s": {name: round(value, 2) for name, value in run.timings_s.items()},
        "peak_memory_mb": run.peak_memory_mb,
        "seconds": round(run.seconds, 1),
        "warnings": run.warnings,
    }
