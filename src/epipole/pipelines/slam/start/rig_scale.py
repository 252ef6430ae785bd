"""Metric scale of a rig whose cameras have no common view, from the trajectory that each camera has estimated alone.

B. Clipp, J.-H. Kim, J.-M. Frahm, M. Pollefeys and R. Hartley, Robust 6DOF motion estimation for non-overlapping, multi-camera systems,
WACV 2008: the known distance between two cameras shows in how differently they move while the rig rotates.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from epipole.geometry import Rigid3, Rotation3

REFERENCES = 4
"""Instants to which all others are compared."""
CORRELATED = 60.0
"""Factor of the variances: errors of successive poses are alike, and so are those of a drifting scale. On rendered rides, scales were up
to 2.5 of the standard deviations off that a factor of 10 gives."""


class RigScales(NamedTuple):
    """Scales of the cameras' maps."""

    scale: np.ndarray
    """(k,) meters per unit of each camera's map."""
    sigma: np.ndarray
    """(k,) standard deviations; infinite if the motion does not determine the scale."""
    rotation_deg: float
    """Median difference between the rotations of the first camera and of another one; large if they do not move together."""
    residual: float
    """Root mean square of the differences, as a fraction of the distance traveled."""


def fit_rig_scales(cam_from_rig: Rigid3, cams_from_world: Sequence[Rigid3]) -> RigScales:
    """Scales with which the cameras move rigidly together.

    With X = cam_k_from_cam_0 and the motions A between two instants, A_k X = X A_0. Its translation is linear in the scales:
    s_k t_k - s_0 R_X t_0 = (1 - R_k) t_X.

    Args:
        cam_from_rig: (k,) of the cameras.
        cams_from_world: for each camera (n,) poses at the same instants, each in another world and unit.
    """
    count, num = len(cams_from_world), len(cams_from_world[0])
    rows, right, angles = [], [], []
    for i in np.unique(np.linspace(0, num - 1, REFERENCES).astype(int)):
        motions = [path @ path[int(i)].inverse() for path in cams_from_world]
        for k in range(1, count):
            between = cam_from_rig[k] @ cam_from_rig[0].inverse()
            expected = between.rotation @ motions[0].rotation @ between.rotation.T
            angles.append(Rotation3(np.swapaxes(expected, 1, 2) @ motions[k].rotation).angle_rad())
            block = np.zeros((num, 3, count))
            block[:, :, 0] = -motions[0].translation @ between.rotation.T
            block[:, :, k] = motions[k].translation
            rows.append(block.reshape(-1, count))
            right.append((between.translation - expected @ between.translation).ravel())
    matrix, value = np.concatenate(rows), np.concatenate(right)
    normal = matrix.T @ matrix
    has_rotated = np.linalg.norm(value) > 1e-6 * np.linalg.norm(cam_from_rig.translation)
    if not has_rotated or not np.isfinite(normal).all() or np.linalg.cond(normal) > 1e12:
        return RigScales(np.ones(count), np.full(count, np.inf), 0.0, np.inf)
    scale = np.linalg.solve(normal, matrix.T @ value)
    off = matrix @ scale - value
    variance = CORRELATED * float(off @ off) / max(len(value) - count, 1)
    sigma = np.sqrt(variance * np.diag(np.linalg.inv(normal)))
    length = np.sqrt(max(float((matrix @ scale) @ (matrix @ scale)), float(value @ value), 1e-300))
    return RigScales(
        scale, sigma, float(np.degrees(np.median(np.concatenate(angles)))), float(np.sqrt(off @ off)) / length
    )
