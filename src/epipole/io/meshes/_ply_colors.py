"""Colours of PLY vertices as 8 bits; files write them in several types and ranges, which no header states.

The type and the values decide:

- `uchar` is 0 to 255; `char` is the same byte, read as signed;
- wider integers are 0 to 255 where no value is larger, else 0 to 65535;
- floating point is 0 to 1 where no value is larger than 1, else 0 to 255, else 0 to 65535. Values between 1 and 2 that are not whole
  are 0 to 1 with an overshoot, which is clipped;
- one property `rgb` or `rgba` of 4 bytes holds the bytes of red, green and blue (PCL).

Two cases are ambiguous: colours of wider integers that are all below 256 are read as 8 bits, and colours in floating point that are all
between 0 and 1 as fractions. Larger values and negative integers are refused; what lies below 0 in floating point becomes 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from epipole.errors import FileFormatError

_NAMES = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
    ("ambient_red", "ambient_green", "ambient_blue"),
)
_PACKED = ("rgb", "rgba")
_MAX_8, _MAX_16 = 255, 65535
_MAX_OVERSHOOT = 2.0
"""Largest value of colours that run from 0 to 1."""


def ply_colours(path: Path, columns: Mapping[str, np.ndarray]) -> UInt8[np.ndarray, "n 3"] | None:
    """The colours of vertices; None where they have none.

    Args:
        path: the file, for errors.
        columns: the vertices' properties by name.

    Raises:
        FileFormatError: the values are in no known range, or one of red, green and blue is missing.
    """
    by_name = {name.lower(): column for name, column in columns.items()}
    for names in _NAMES:
        found = [name for name in names if name in by_name]
        if len(found) == 3:
            return _scaled(path, np.stack([by_name[name] for name in names], axis=1))
        if found and names != ("r", "g", "b"):
            missing = ", ".join(name for name in names if name not in found)
            raise FileFormatError(path, f"the vertices have the colour {', '.join(found)} but no {missing}")
    packed = next((by_name[name] for name in _PACKED if name in by_name), None)
    return None if packed is None else _unpacked(packed)


def _unpacked(packed: np.ndarray) -> UInt8[np.ndarray, "n 3"]:
    """Red, green and blue of 0xAARRGGBB, which may be stored as the bits of a float."""
    bits = packed.astype(np.float32).view(np.uint32) if packed.dtype.kind == "f" else packed.astype(np.uint32)
    return np.stack([bits >> 16, bits >> 8, bits], axis=1).astype(np.uint8)


def _scaled(path: Path, rgb: np.ndarray) -> UInt8[np.ndarray, "n 3"]:
    if rgb.dtype == np.uint8:
        return rgb
    if rgb.dtype == np.int8:
        return rgb.view(np.uint8)
    values = rgb.astype(np.float64)
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    is_whole = not (known % 1.0).any()
    full = float(_MAX_8 if high <= _MAX_8 else _MAX_16)
    if rgb.dtype.kind == "f" and (high <= 1.0 or (high <= _MAX_OVERSHOOT and not is_whole)):
        full = 1.0
    if high > _MAX_16 or (low < 0.0 and rgb.dtype.kind != "f"):
        problem = f"the colours of the vertices run from {low:g} to {high:g}, which is no known range"
        raise FileFormatError(path, f"{problem}; write them as uchar, 0 to 255")
    scaled = np.nan_to_num(values * (_MAX_8 / full), nan=0.0, posinf=_MAX_8, neginf=0.0)
    return np.clip(np.rint(scaled), 0, _MAX_8).astype(np.uint8)
