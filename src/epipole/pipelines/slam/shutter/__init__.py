"""Rolling shutters: motion during the readout, and detection of an unknown readout."""
