"""Tracking: where the points of the map are in a frame, and the pose that follows."""
