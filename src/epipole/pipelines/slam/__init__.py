"""SLAM: the trajectory of a moving camera and a map of the scene, frame by frame."""
