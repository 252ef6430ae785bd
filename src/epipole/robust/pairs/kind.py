"""Kinds of image pairs."""

from enum import IntEnum


class PairKind(IntEnum):
    """The kind of a verified pair of images."""

    DEGENERATE = 0
    """Too few consistent matches."""
    GENERAL = 1
    """Calibrated, with parallax: an essential matrix explains it."""
    UNCALIBRATED = 2
    """Focal lengths unknown: a fundamental matrix explains it."""
    PLANAR = 3
    """A plane with parallax: a homography explains it."""
    ROTATION = 4
    """Pure rotation: depth cannot be determined."""
    NO_MOTION = 5
    """The same image twice."""
