"""Tracking of the map's points in a frame, and pose estimation from them."""
