"""Radiance fields: voxel grids and hash grids."""
