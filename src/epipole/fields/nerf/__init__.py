"""Radiance fields on voxel grids and hash grids."""
