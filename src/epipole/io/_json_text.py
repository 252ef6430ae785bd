"""JSON that may be nested without end, or hold more than fits."""

from __future__ import annotations

import json
from typing import Any

_MOST_VALUES = 1 << 23


def json_values(text: str, *, allow_nan: bool = False) -> Any:
    """What a JSON text holds.

    Raises:
        ValueError: it is none, is nested too deeply, or holds more values than any file of ours.
    """
    # Three bytes of text may become a hundred of memory.
    if sum(text.count(mark) for mark in ",[{") > _MOST_VALUES:
        raise ValueError(f"more than {_MOST_VALUES} values")
    try:
        return json.loads(text, parse_constant=None if allow_nan else _no_constant)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def _no_constant(word: str) -> float:
    raise ValueError(f"{word} is not a finite number")
