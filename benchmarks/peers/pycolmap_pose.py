"""COLMAP's absolute pose on given matches: `python -m benchmarks.peers.pycolmap_pose MATCHES.npz OUT.npz`."""

from __future__ import annotations

import sys
from time import perf_counter

import numpy as np


def main() -> None:
    """Estimate and refine the pose of every image; write poses (n, 3, 4), NaN where there is none, and seconds (n,)."""
    import pycolmap

    stored = np.load(sys.argv[1])
    width, height, fx, fy, cx, cy = stored["camera"].tolist()
    camera = pycolmap.Camera(
        model="PINHOLE", width=int(width), height=int(height), params=[fx, fy, cx + 0.5, cy + 0.5]
    )
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = float(stored["max_error_px"])
    poses, seconds = [], []
    for start, stop in zip(stored["offsets"][:-1], stored["offsets"][1:]):
        pixels, points = stored["pixels"][start:stop] + 0.5, stored["points"][start:stop]
        begin = perf_counter()
        found = pycolmap.estimate_and_refine_absolute_pose(pixels, points, camera, options)
        seconds.append(perf_counter() - begin)
        poses.append(np.full((3, 4), np.nan) if found is None else found["cam_from_world"].matrix())
    np.savez(sys.argv[2], poses=np.array(poses), seconds=np.array(seconds))


if __name__ == "__main__":
    main()
