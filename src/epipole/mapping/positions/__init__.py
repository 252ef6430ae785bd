"""Positions of all cameras at once, from rotations, directions and tracks."""
