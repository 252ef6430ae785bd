"""Undistortion: a model and its pictures as pinhole cameras would have taken them."""
