"""Initialization of the map of a single camera."""
