"""Tasks: data, known calibration, and ground truth."""
