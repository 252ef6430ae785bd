"""Conversion of PLY vertex colors to 8 bits; files use several types and ranges, which the header does not state.

The range is determined from the type and the values:

- `uchar` is 0 to 255; `char` is the same byte, read as signed;
- wider integers are 0 to 255 if no value is larger, else 0 to 65535;
- floating point is 0 to 1 if no value is larger than 1, else 0 to 255, else 0 to 65535. Non-integer values up to 2 are
  taken as 0 to 1 with overshoot, which is clipped;
- a single 4-byte property `rgb` or `rgba` contains the bytes of red, green and blue (PCL).

Two cases are ambiguous: wider integers that are all below 256 are read as 8-bit colors, and floats that are all between
0 and 1 as fractions. Larger values and negative integers are rejected; negative floats become 0.
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
"""Largest value of colors in the range 0 to 1, including overshoot."""


def ply_colors(path: Path, columns: Mapping[str, np.ndarray]) -> UInt8[np.ndarray, "n 3"] | None:
    """The colors of vertices; None if they have none.

    Args:
        path: the file, for error messages.
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
            raise FileFormatError(path, f"the vertices have the color {', '.join(found)} but no {missing}")
    packed = next((by_name[name] for name in _PACKED if name in by_name), None)
    return None if packed is None else _unpacked(packed)


def _unpacked(packed: np.ndarray) -> UInt8[np.ndarray, "n 3"]:
    """Red, green and blue from 0xAARRGGBB, which may be stored as the bits of a float."""
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
        problem = f"the vertex colors range from {low:g} to {high:g}, which is not a known range"
        raise FileFormatError(path, f"{problem}; write them as uchar, 0 to 255")
    scaled = np.nan_to_num(values * (_MAX_8 / full), nan=0.0, posinf=_MAX_8, neginf=0.0)
    return np.clip(np.rint(scaled), 0, _MAX_8).astype(np.uint8)
