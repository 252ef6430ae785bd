"""Memory of this process."""

from __future__ import annotations

import re
import sys
from pathlib import Path

_UNIT_BYTES = 1 if sys.platform == "darwin" else 1024
"""Unit of the operating system's number."""


def peak_memory_mb() -> float | None:
    """Largest resident memory of this process so far, without those it has started; None on Windows, which counts otherwise."""
    peak = _status_mb("VmHWM")
    if peak is not None:  # on Linux, ru_maxrss of a child process starts with the peak of its parent
        return peak
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _UNIT_BYTES / 1e6


def memory_mb() -> float | None:
    """Present resident memory of this process, without those it has started; None if the system does not report it."""
    return _status_mb("VmRSS")


def _status_mb(name: str) -> float | None:
    status = Path("/proc/self/status")
    found = re.search(rf"^{name}:\s+(\d+) kB", status.read_text(), re.MULTILINE) if status.is_file() else None
    return None if found is None else int(found[1]) * 1024 / 1e6
