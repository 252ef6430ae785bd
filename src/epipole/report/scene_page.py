"""A scene that is shown by one file."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ScenePage:
    """What a pipeline's scene makes of a path when it is shared."""

    html: str
    """The whole page; it loads nothing."""
    shown: str
    """What it shows, and of how much, in words."""
