"""Calibration: cameras and rigs from views of a board, with what is known of their errors."""
