"""Calibration of cameras and rigs from views of a board, with covariances."""
