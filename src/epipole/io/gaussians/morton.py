"""Morton order (1966): points close in space are mostly close in the order, which helps compression."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt64

from epipole._checks import checked

_BITS, _MOST = 16, 65535


@checked
def morton_codes(points: Float[np.ndarray, "n 3"]) -> UInt64[np.ndarray, " n"]:
    """Interleaved bits of x, y and z, with 16 bits each within their range."""
    if not len(points):
        return np.empty(0, np.uint64)
    wide = points.astype(np.float64)
    lows, spans = wide.min(axis=0), np.maximum(np.ptp(wide, axis=0), 1e-30)
    return interleaved(np.rint(_MOST / spans * (wide - lows)).astype(np.uint64))


@checked
def interleaved(codes: UInt64[np.ndarray, "n 3"]) -> UInt64[np.ndarray, " n"]:
    """Interleave the bits of (n, 3) 16-bit integers."""
    out = np.zeros(len(codes), np.uint64)
    for bit in range(_BITS):
        for axis in range(3):
            shifted = codes[:, axis].astype(np.uint64) >> np.uint64(bit) & np.uint64(1)
            out |= shifted << np.uint64(3 * bit + axis)
    return out
