"""Memory of this process."""

from __future__ import annotations

import sys

_UNIT_BYTES = 1 if sys.platform == "darwin" else 1024
"""Unit of the operating system's number."""


def peak_memory_mb() -> float | None:
    """Largest resident memory of this process so far, without those it has started; None on Windows, which counts otherwise."""
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _UNIT_BYTES / 1e6
