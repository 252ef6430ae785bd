"""Sources of frames and camera intrinsics."""
