"""Trajectories: TUM, KITTI, EuRoC."""
