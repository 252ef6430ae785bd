"""Trajectory files: TUM, KITTI, EuRoC."""
