"""Size limits of a shared page."""

from __future__ import annotations

USUAL_SHARED, MOST_SHARED = 500_000, 4_000_000
"""Points or Gaussians, 16 to 44 bytes each, plus a third as text. Browsers reject texts above half a gigabyte."""
