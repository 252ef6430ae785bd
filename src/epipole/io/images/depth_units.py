"""The unit of 16-bit depth images: the layout suggests one, and the stored values must be plausible with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole.errors import FileFormatError
from epipole.io.images.depth_maps import read_png16

TUM_VALUES_PER_M, MM_VALUES_PER_M = 5000.0, 1000.0
NO_DEPTH = 65535
"""Stored by some sensors (7-Scenes) for missing depth, besides zero."""
_SAMPLES, _STEP_PX = 5, 3
"""Number of depth images sampled, and the pixel step within each."""
_NEAREST_M, _FARTHEST_M = 0.2, 10.0
"""Range of consumer depth sensors: at most 1 % of the values may be nearer, and 1 % farther."""
_MEDIAN_M = 0.4
_MIN_LEVELS = 50
"""With fewer distinct values, all of them may be multiples of five by chance."""


@dataclass(frozen=True, slots=True)
class DepthUnit:
    """A depth unit, its source, and warnings about it."""

    values_per_m: float
    source: str
    warnings: tuple[str, ...] = ()


def sample_depth(files: Sequence[Path]) -> np.ndarray:
    """(n,) stored values of a few evenly spaced images; unreadable files are skipped, and reported when used."""
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
    """The proposed unit, or the other common one if only that gives distances within the range of a depth sensor.

    Args:
        values: stored values of some images.
        proposed: stored values per meter.
        proposer: source of the proposal, for messages.
    """
    other = MM_VALUES_PER_M if proposed == TUM_VALUES_PER_M else TUM_VALUES_PER_M
    if not len(values) or (proposed == TUM_VALUES_PER_M and _are_scaled_millimeters(values)):
        return DepthUnit(proposed, proposer)
    fits, other_fits = (is_plausible(values, unit) for unit in (proposed, other))
    # Sensors write millimeters, and only TUM's tools use another unit: if both fit, millimeters need no confirmation.
    if fits and other_fits and proposed == TUM_VALUES_PER_M:
        words = (
            f"depth is read with {proposed:g} values per meter ({proposer}), but {other:g} would also give plausible distances "
            f"({_range(values, proposed)} or {_range(values, other)}): pass --depth-scale to confirm or change it"
        )
        return DepthUnit(proposed, f"{proposer}; {other:g} is also possible", (words,))
    if other_fits and not fits:
        words = (
            f"depth is read with {other:g} values per meter: with {proposed:g} ({proposer}) it would range over "
            f"{_range(values, proposed)}, with {other:g} over {_range(values, other)}. If that is wrong, pass --depth-scale"
        )
        return DepthUnit(other, f"the stored values, overriding {proposer} ({proposed:g})", (words,))
    return DepthUnit(proposed, proposer)


def is_plausible(values: np.ndarray, values_per_m: float) -> bool:
    """Whether the values are within the range of a consumer depth sensor at `values_per_m`."""
    if not len(values):
        return True
    near, middle, far = np.percentile(values, [1.0, 50.0, 99.0]) / values_per_m
    return bool(near >= _NEAREST_M and middle >= _MEDIAN_M and far <= _FARTHEST_M)


def _are_scaled_millimeters(values: np.ndarray) -> bool:
    """Whether all values are multiples of five: millimeters stored in units of 0.2 mm."""
    return len(np.unique(values)) >= _MIN_LEVELS and not (values % 5.0).any()


def _range(values: np.ndarray, values_per_m: float) -> str:
    near, far = np.percentile(values, [1.0, 99.0]) / values_per_m
    return f"{near:.2g} to {far:.2g} m"
