"""Trajectories and loops as curves in an upright world, for the report and the viewer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from epipole.geometry import Rigid3, Rotation3, Similarity3
from epipole.scene import Curve, Reconstruction, Trajectory, path_segments

FINAL_RGB, CAUSAL_RGB, TRUTH_RGB, LOOP_RGB = (31, 138, 176), (150, 150, 160), (226, 134, 42), (196, 62, 142)
FINAL, CAUSAL, TRUTH, LOOPS = "final", "causal", "truth", "loops"
GAP = 1.5
"""Poses are not connected if their time difference exceeds this multiple of the median step."""
TRUTH_GAP = 20.0
"""The same for the true trajectory."""


def upright_from_world(world_from_body: Rigid3) -> Similarity3:
    """Rotation into a world with +z up and the first camera's forward direction along +y.

    Up is the mean upward direction of the images, which is right for level cameras and for cameras rolled to all sides.
    """
    up = -world_from_body.rotation[:, :, 1].mean(axis=0) if len(world_from_body.rotation) else np.zeros(3)
    # For a level camera (x right, y down, z forward): z to y, -y to z.
    start = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    up = start @ up
    size = float(np.linalg.norm(up))
    rotation = np.eye(3)
    if size > 1e-6:
        rotation = Rotation3.from_two_vectors(up / size, np.array([0.0, 0.0, 1.0])).matrix
    return Similarity3(np.asarray(1.0), rotation @ start, np.zeros(3))


def path_curve(
    name: str, path: Trajectory, rgb: tuple[int, int, int], gap: float = GAP, *, is_shown: bool = True
) -> Curve:
    """Curve of a trajectory, broken at time gaps."""
    steps = np.diff(path.timestamp_s, prepend=path.timestamp_s[:1])
    usual = float(np.median(steps[1:])) if len(steps) > 1 else 0.0
    return Curve(name, path_segments(path.world_from_body.translation, steps <= gap * usual), rgb, is_shown)


def loop_curve(loops: Sequence[Mapping[str, Any]], model: Reconstruction, numbers: Sequence[int]) -> Curve:
    """Lines between the keyframes of accepted loops.

    Args:
        loops: loops of the summary.
        model: reconstruction whose images are the keyframes.
        numbers: frame numbers of the keyframes in the source.
    """
    centers = model.camera_centers_in_world()
    frames, pieces = np.array(numbers, np.int64), []
    for loop in loops:
        keyframe = int(loop.get("keyframe", -1))
        if loop.get("verdict") == "accepted" and len(frames) and 0 <= keyframe < len(centers):
            nearest = int(np.argmin(np.abs(frames - int(loop.get("frame", -1)))))
            pieces.append(np.stack([centers[nearest], centers[keyframe]]))
    return Curve(LOOPS, np.array(pieces, np.float64).reshape(-1, 2, 3), LOOP_RGB)
