"""SLAM: the path of a moving camera and the map that it sees, frame by frame."""
