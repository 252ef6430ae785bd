"""Radiance fields: scenes that are drawn, and learnt from images, by their colour and density in space."""
