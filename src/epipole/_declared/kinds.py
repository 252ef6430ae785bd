"""What converters of values are."""

from collections.abc import Callable
from typing import Any

Sizes = dict[str, tuple[int, str]]
"""Of each named axis the length, and the argument that has it."""
Convert = Callable[[Any, str, Sizes], Any]
"""(value, name, sizes) -> the value to go on with."""
