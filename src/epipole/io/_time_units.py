"""Detection of timestamps in milliseconds, microseconds or nanoseconds from their size and spacing."""

from __future__ import annotations

import numpy as np

_UNITS = ((1e17, 1e-9, "nanoseconds"), (1e14, 1e-6, "microseconds"), (1e11, 1e-3, "milliseconds"))
"""(threshold, factor to seconds, unit): larger numbers are dates after 1973 in this unit (in seconds, after 5000)."""
_STEP_S = 1e-4, 2.0
"""Usual time between rows, seconds. Nanoseconds since boot are smaller than nanoseconds since 1970; the spacing
distinguishes them from microseconds and milliseconds."""


def unit_of_clock(values: np.ndarray) -> tuple[float, str] | None:
    """Factor to seconds and name of the unit of clock times; None if they are seconds, or too small to decide."""
    largest = float(np.abs(values).max()) if len(values) else 0.0
    by_size = next(((factor, name) for least, factor, name in _UNITS if largest >= least), None)
    steps = np.abs(np.diff(values))
    if by_size is None or not (steps > 0).any():
        return by_size
    step = float(np.median(steps[steps > 0]))
    usual = [(factor, name) for _, factor, name in _UNITS if _STEP_S[0] <= step * factor <= _STEP_S[1]]
    return usual[0] if len(usual) == 1 else by_size


def seconds_of(values: np.ndarray) -> tuple[np.ndarray, str | None]:
    """Times in seconds, and the name of their original unit if it was not seconds."""
    unit = unit_of_clock(values)
    return (values, None) if unit is None else (values * unit[0], unit[1])
