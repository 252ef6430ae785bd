"""What two images tell about each other."""

from enum import IntEnum


class PairKind(IntEnum):
    """The kind of a verified pair of images."""

    DEGENERATE = 0
    """Too few consistent matches: the pair tells nothing."""
    GENERAL = 1
    """Calibrated, with parallax: an essential matrix explains it."""
    UNCALIBRATED = 2
    """Focal lengths not known: a fundamental matrix explains it."""
    PLANAR = 3
    """A homography explains it and there is parallax: a plane."""
    ROTATION = 4
    """The camera only turned: no depth can be had."""
    NO_MOTION = 5
    """The same image twice."""
