"""Undistortion: a model and its images as pinhole cameras would have taken them."""
