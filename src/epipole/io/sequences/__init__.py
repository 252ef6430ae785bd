"""Sequences of images with times, depth and IMU measurements."""
