"""Stereo: disparities, depth and points from a rectified, calibrated or uncalibrated pair."""
