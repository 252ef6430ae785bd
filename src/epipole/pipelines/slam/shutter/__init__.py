"""Rolling shutters: the motion during the readout, and a check for one that nobody mentioned."""
