"""Types of converters."""

from collections.abc import Callable
from typing import Any

Sizes = dict[str, tuple[int, str]]
"""Length of each named axis, and the argument that has it."""
Convert = Callable[[Any, str, Sizes], Any]
"""(value, name, sizes) -> the checked and converted value."""
