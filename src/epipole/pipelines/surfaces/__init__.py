"""Surfaces from images: depth of each view, a fused cloud and a mesh."""
