"""Texture of a mesh from the images that see it."""
