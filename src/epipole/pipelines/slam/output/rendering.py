"""Paths and loops as lines, in an upright world: for the report and for the viewer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from epipole.geometry import Rigid3, Rotation3, Similarity3
from epipole.scene import Curve, Reconstruction, Trajectory, path_segments

FINAL_RGB, CAUSAL_RGB, TRUTH_RGB, LOOP_RGB = (31, 138, 176), (150, 150, 160), (226, 134, 42), (196, 62, 142)
FINAL, CAUSAL, TRUTH, LOOPS = "final", "as it came", "truth", "loops"
GAP, TRUTH_GAP = 1.5, 20.0
"""Instants further apart than so many usual steps of time are not joined: the place between them is not known."""


def upright_from_world(world_from_body: Rigid3) -> Similarity3:
    """The turn that makes +z up and leaves the first camera's forward direction along +y.

    Up is the mean of the images' upward directions: cameras are held level, or turned to all sides.
    """
    up = -world_from_body.rotation[:, :, 1].mean(axis=0) if len(world_from_body.rotation) else np.zeros(3)
    # A level camera (x right, y down, z forward) as the start: z to y, -y to z.
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
    """A path, broken where the place was not known for a while."""
    steps = np.diff(path.timestamp_s, prepend=path.timestamp_s[:1])
    usual = float(np.median(steps[1:])) if len(steps) > 1 else 0.0
    return Curve(name, path_segments(path.world_from_body.translation, steps <= gap * usual), rgb, is_shown)


def loop_curve(loops: Sequence[Mapping[str, Any]], model: Reconstruction, numbers: Sequence[int]) -> Curve:
    """Lines between the keyframes of accepted loops.

    Args:
        loops: the summary's.
        model: its images are the keyframes.
        numbers: of the keyframes' frames in the source.
    """
    centers = model.camera_centers_in_world()
    frames, pieces = np.array(numbers, np.int64), []
    for loop in loops:
        keyframe = int(loop.get("keyframe", -1))
        if loop.get("verdict") == "accepted" and len(frames) and 0 <= keyframe < len(centers):
            nearest = int(np.argmin(np.abs(frames - int(loop.get("frame", -1)))))
            pieces.append(np.stack([centers[nearest], centers[keyframe]]))
    return Curve(LOOPS, np.array(pieces, np.float64).reshape(-1, 2, 3), LOOP_RGB)
