"""World frame of a model without GPS: upright, centered, and normalized in scale."""

from __future__ import annotations

import numpy as np

from epipole.geometry import Rigid3, Rotation3, Similarity3
from epipole.pipelines.sfm.up_direction import UpDirection


def upright_from_world(cams_from_world: Rigid3, points_in_world: np.ndarray, up: UpDirection) -> Similarity3:
    """Similarity that rotates +z up, centers the model, and scales the median distance of its points to one."""
    rotation = Rotation3.from_two_vectors(up.direction, np.array([0.0, 0.0, 1.0])).matrix
    centers = cams_from_world.centers()
    middle = np.median(points_in_world, axis=0) if len(points_in_world) else centers.mean(axis=0)
    reach = (
        float(np.median(np.linalg.norm(points_in_world - middle, axis=1))) if len(points_in_world) else 1.0
    )
    scale = 1.0 / reach if reach > 0 else 1.0
    return Similarity3(np.asarray(scale), rotation, -scale * rotation @ middle)
