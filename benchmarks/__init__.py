"""Benchmarks of epipole, alone and against other programs on the same data under the same limits."""
