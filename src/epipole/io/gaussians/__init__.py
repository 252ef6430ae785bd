"""Files of 3D Gaussians: PLY, compressed PLY, SPZ, SOG, splat."""
