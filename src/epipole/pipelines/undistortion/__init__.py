"""Undistortion of a model and its images to pinhole cameras."""
