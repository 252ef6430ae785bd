"""JSON with limits on nesting and size when reading, and strictly valid JSON when writing.

NaN and infinity, which JSON does not have, are rejected when reading and written as null.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from epipole._checks import checked
from epipole.errors import FileFormatError

_MOST_VALUES = 1 << 23


@checked
def json_values(path: Path, text: str, *, allow_nan: bool = False) -> Any:
    """Parse the JSON text of a file.

    Args:
        path: the file, for error messages.
        text: its text.
        allow_nan: whether to accept NaN and Infinity.

    Raises:
        FileFormatError: not JSON, nested too deeply, has a duplicate key, or has too many values.
    """
    # Three bytes of text can take a hundred bytes of memory.
    if sum(text.count(mark) for mark in ",[{") > _MOST_VALUES:
        raise FileFormatError(path, f"too large: more than {_MOST_VALUES} values")
    try:
        constant = None if allow_nan else _no_constant
        return json.loads(text, parse_constant=constant, object_pairs_hook=_without_repeats)
    except RecursionError as error:
        raise FileFormatError(path, "not JSON: nested too deeply") from error
    except ValueError as error:
        raise FileFormatError(
            path, f"not JSON: {error}; check that this is the right file, and complete"
        ) from error


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Build an object; rejects duplicate keys, of which json would silently keep the last."""
    out = dict(pairs)
    if len(out) < len(pairs):
        twice = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"duplicate key {twice[:80]!r}")
    return out


def _no_constant(word: str) -> float:
    raise ValueError(f"{word} is not a finite number")


@checked
def json_text(content: Any, indent: int = 2) -> str:
    """JSON text of a value; paths and other objects are written as strings."""
    return json.dumps(_plain(content), indent=indent, allow_nan=False, default=str) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(name): _plain(part) for name, part in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, np.generic):
        return _plain(value.item())
    return None if isinstance(value, float) and not math.isfinite(value) else value
