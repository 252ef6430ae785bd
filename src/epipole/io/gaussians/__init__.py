"""Files of Gaussian clouds: PLY, compressed PLY, SPZ, SOG, splat."""
