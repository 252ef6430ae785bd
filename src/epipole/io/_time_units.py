"""Times that are not in seconds: clocks of computers count far, and their numbers show the unit."""

from __future__ import annotations

import numpy as np

_UNITS = ((1e17, 1e-9, "nanoseconds"), (1e14, 1e-6, "microseconds"), (1e11, 1e-3, "milliseconds"))
"""Numbers from here on, in the named unit, are instants after 1973; in seconds, years after 5000."""


def unit_of_clock(values: np.ndarray) -> tuple[float, str] | None:
    """Seconds for a unit, and its name, of times since 1970 that are not in seconds; None for seconds, or any other origin."""
    largest = float(np.abs(values).max()) if len(values) else 0.0
    return next(((factor, name) for least, factor, name in _UNITS if largest >= least), None)


def seconds_of(values: np.ndarray) -> tuple[np.ndarray, str | None]:
    """Times in seconds, and the name of their unit where it was another."""
    unit = unit_of_clock(values)
    return (values, None) if unit is None else (values * unit[0], unit[1])
