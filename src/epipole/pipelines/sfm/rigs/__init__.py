"""Rigs in reconstruction: cameras that move together, with known or constant geometry."""
