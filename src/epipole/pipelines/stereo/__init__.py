"""Stereo: two images of a rectified, calibrated or unknown pair to disparities, depth and points."""
