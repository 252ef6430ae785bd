"""The unit of 16-bit depth images: a layout proposes it, and the stored values must agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole.errors import FileFormatError
from epipole.io.images.depth_maps import read_png16

TUM_VALUES_PER_M, MM_VALUES_PER_M = 5000.0, 1000.0
NO_DEPTH = 65535
"""What some sensors store where they measure nothing, besides zero (7-Scenes)."""
_SAMPLES, _STEP_PX = 5, 3
"""Depth images that are looked at, and every which pixel of them."""
_NEAREST_M, _FARTHEST_M = 0.2, 10.0
"""What consumer depth sensors reach: no more than 1 % of the values may lie nearer, or farther."""
_MEDIAN_M = 0.4
_MIN_LEVELS = 50
"""With fewer distinct values, that all are multiples of five is chance."""


@dataclass(frozen=True, slots=True)
class DepthUnit:
    """The unit, where it comes from, and what is uncertain about it."""

    values_per_m: float
    source: str
    warnings: tuple[str, ...] = ()


def sample_depth(files: Sequence[Path]) -> np.ndarray:
    """(n,) stored values of a few images, evenly chosen; files that cannot be read are passed over: they are named when their turn comes."""
    rows = np.unique(np.linspace(0, max(len(files) - 1, 0), _SAMPLES).astype(int))[: len(files)]
    parts = [np.zeros(0)]
    for row in rows:
        try:
            values = read_png16(files[row], 1.0)[::_STEP_PX, ::_STEP_PX]
        except FileFormatError:
            continue
        parts.append(values[np.isfinite(values)].astype(np.float64))
    values = np.concatenate(parts)
    return values[values < NO_DEPTH]


def decide_unit(values: np.ndarray, proposed: float, proposer: str) -> DepthUnit:
    """The proposed unit, or the other usual one where only that makes the values distances that a depth sensor measures.

    Args:
        values: of some images.
        proposed: stored values for a metre.
        proposer: what proposes it, in words.
    """
    other = MM_VALUES_PER_M if proposed == TUM_VALUES_PER_M else TUM_VALUES_PER_M
    if not len(values) or (proposed == TUM_VALUES_PER_M and _are_scaled_millimetres(values)):
        return DepthUnit(proposed, proposer)
    fits, other_fits = (is_plausible(values, unit) for unit in (proposed, other))
    # Sensors write millimetres, and only TUM's tools another unit: where both fit, millimetres need no confirmation.
    if fits and other_fits and proposed == TUM_VALUES_PER_M:
        words = (
            f"depth is read with {proposed:g} values for a metre ({proposer}), but {other:g} would give usual distances, too "
            f"({_range(values, proposed)} or {_range(values, other)}): pass --depth-scale to confirm or change it"
        )
        return DepthUnit(proposed, f"{proposer}; {other:g} is possible, too", (words,))
    if other_fits and not fits:
        words = (
            f"depth is read with {other:g} values for a metre: with the {proposed:g} of {proposer} it would be "
            f"{_range(values, proposed)}, with {other:g} it is {_range(values, other)}. Pass --depth-scale if that is wrong"
        )
        return DepthUnit(other, f"the stored values, against {proposer} ({proposed:g})", (words,))
    return DepthUnit(proposed, proposer)


def is_plausible(values: np.ndarray, values_per_m: float) -> bool:
    """Whether the values are distances that a consumer depth sensor measures, if so many are a metre."""
    if not len(values):
        return True
    near, middle, far = np.percentile(values, [1.0, 50.0, 99.0]) / values_per_m
    return bool(near >= _NEAREST_M and middle >= _MEDIAN_M and far <= _FARTHEST_M)


def _are_scaled_millimetres(values: np.ndarray) -> bool:
    """Whether all values are multiples of five: millimetres of a sensor that were stored in fifths of one."""
    return len(np.unique(values)) >= _MIN_LEVELS and not (values % 5.0).any()


def _range(values: np.ndarray, values_per_m: float) -> str:
    near, far = np.percentile(values, [1.0, 99.0]) / values_per_m
    return f"{near:.2g} to {far:.2g} m"
