"""Kernels as Python, for a debugger, with the behavior of compiled code where Python would raise.

Compiled code divides by zero like NumPy, and its square root of a negative number is NaN. In Python NumPy scalars do the same,
but `math` raises. Remaining differences: sums and products of integers and of float32 with a Python number are computed in the
type of the array, not in 64 bits, and rows are combined without fused multiply-add, so last digits differ.
"""

import math
from collections.abc import Callable
from functools import wraps
from types import SimpleNamespace
from typing import Any

import numpy as np

_FUNCTIONS = ("sqrt", "log", "exp", "cos", "sin", "log1p", "acos", "atan2", "copysign")
_IN_NUMPY = {"acos": "arccos", "atan2": "arctan2"}
_LOWEST = -(2**63)


def _number_of_numpy(name: str) -> Callable[..., Any]:
    """A function of `math` that returns NumPy scalars, and NumPy's result where Python raises."""
    exact, other = getattr(math, name), getattr(np, _IN_NUMPY.get(name, name))

    def function(*values: Any) -> Any:
        kind = np.float32 if all(isinstance(value, np.float32) for value in values) else np.float64
        try:
            return kind(exact(*values))
        except (ValueError, OverflowError):
            return kind(other(*values))

    return function


def _whole_number(rounded: Callable[..., int]) -> Callable[..., int]:
    """`floor` or `ceil` that maps NaN and infinity to the lowest integer, like the processor."""
    return lambda value: rounded(value) if math.isfinite(value) else _LOWEST


MATH = SimpleNamespace(
    **{name: _number_of_numpy(name) for name in _FUNCTIONS},
    floor=_whole_number(math.floor),
    ceil=_whole_number(math.ceil),
    isfinite=math.isfinite,
    inf=math.inf,
    nan=math.nan,
    pi=math.pi,
)
"""Replacement for `math` in kernels."""


def run_as_python(function: Callable[..., Any]) -> Any:
    """The function, silent about overflow and division by zero, with `math` replaced in its module."""
    if function.__globals__.get("math") is math:
        function.__globals__["math"] = MATH

    @wraps(function)
    def run(*arguments: Any) -> Any:
        with np.errstate(all="ignore"):
            return function(*arguments)

    return run
