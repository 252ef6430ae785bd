"""Comparisons of epipole with other programs: the same pictures, the same limits, quality and time in one row."""
