"""Radiance fields: scenes that are drawn, and learnt from pictures, by their colour and density in space."""
