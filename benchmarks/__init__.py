"""Comparisons of epipole with other programs: the same images, the same limits, quality and time in one row."""
