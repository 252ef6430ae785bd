"""Memory of this process."""

from __future__ import annotations

import re
import sys
from pathlib import Path

_UNIT_BYTES = 1 if sys.platform == "darwin" else 1024
"""Unit of the operating system's number."""


def peak_memory_mb() -> float | None:
    """Largest resident memory of this process so far, without those it has started; None on Windows, which counts otherwise."""
    status = Path("/proc/self/status")
    if status.is_file():  # on Linux, ru_maxrss of a child process starts with the peak of its parent
        peak = re.search(r"^VmHWM:\s+(\d+) kB", status.read_text(), re.MULTILINE)
        if peak is not None:
            return int(peak[1]) * 1024 / 1e6
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _UNIT_BYTES / 1e6
