"""How much a shared page holds."""

from __future__ import annotations

USUAL_SHARED, MOST_SHARED = 500_000, 4_000_000
"""Points or Gaussians, 16 to 44 bytes each, and a third more as text. A browser refuses texts beyond half a gigabyte."""
