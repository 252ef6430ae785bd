"""Up direction of a model: from measured gravity, or from how people and drones usually hold cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from epipole.geometry import Rigid3

MIN_SPAN = 0.05
"""Second eigenvalue of the mean x x^T below which the x axes are parallel, and orthogonal to a whole plane."""
MAX_OFF_LEVEL = 0.05
"""First eigenvalue above which the x axes are not level, and no direction is orthogonal to all of them."""
MIN_AGREEMENT = 0.3
"""Smallest length of a mean of unit vectors that is more than chance."""
GRAVITY_SIGMA_RAD, LEVEL_SIGMA_RAD, HANDHELD_SIGMA_RAD = np.deg2rad([2.0, 4.0, 12.0])
"""Standard deviations of a gimbal's measurement, of level x axes, and of cameras held upright or facing down."""
MAX_GRAVITY_ERROR_RAD = np.deg2rad(10.0)
"""Measured directions that differ by more from their median, in most images, are not used."""


@dataclass(frozen=True, slots=True, eq=False)
class UpDirection:
    """A unit vector in model coordinates that may point up."""

    direction: np.ndarray
    sigma_rad: float
    is_measured: bool = False
    """Measured by a sensor; otherwise assumed from how cameras are usually held."""


def up_directions(cams_from_world: Rigid3, up_in_cams: np.ndarray | None = None) -> list[UpDirection]:
    """Possible up directions, most likely first; at least one.

    Level cameras have horizontal x axes, whether they look ahead, obliquely or down, so if the x axes span a plane, its
    normal is up (Szeliski, Image Alignment and Stitching, 2006). Its sign comes from the y axes, which point down in
    cameras that look ahead, or else from the z axes, since other cameras mostly look down. If the x axes are parallel
    (a straight flight), both -y and -z may be up.

    Args:
        cams_from_world: poses of the registered images.
        up_in_cams: (n, 3) measured up directions in camera coordinates, NaN rows for none.
    """
    measured = _measured(cams_from_world, up_in_cams)
    if measured is not None:
        return [measured]
    x_axes, y_axes, z_axes = (cams_from_world.rotation[:, k] for k in range(3))
    mean_y, mean_z = y_axes.mean(axis=0), z_axes.mean(axis=0)
    length_y, length_z = float(np.linalg.norm(mean_y)), float(np.linalg.norm(mean_z))
    usual = []
    if length_y > MIN_AGREEMENT:
        usual.append(UpDirection(-mean_y / length_y, float(HANDHELD_SIGMA_RAD)))
    if length_z > MIN_AGREEMENT:
        # Varying headings average out the tilt of the camera.
        sigma_rad = HANDHELD_SIGMA_RAD if length_y > MIN_AGREEMENT else LEVEL_SIGMA_RAD
        usual.append(UpDirection(-mean_z / length_z, float(sigma_rad)))
    values, vectors = np.linalg.eigh(x_axes.T @ x_axes / len(x_axes))
    if values[1] <= MIN_SPAN or values[0] > MAX_OFF_LEVEL:
        if len(usual) == 2 and length_z - length_y > MIN_AGREEMENT:
            usual.reverse()  # back and forth, looking down: the y axes cancel out, the z axes agree
        return usual or [UpDirection(_any_up(mean_y), float(HANDHELD_SIGMA_RAD))]
    normal = vectors[:, 0]
    along_y, along_z = float(normal @ mean_y), float(normal @ mean_z)
    sign = -np.sign(along_y if abs(along_y) > MIN_AGREEMENT else along_z) or 1.0
    level = UpDirection(sign * normal, float(LEVEL_SIGMA_RAD))
    return [level, *(up for up in usual if abs(up.direction @ normal) < np.cos(2 * HANDHELD_SIGMA_RAD))]


def _measured(cams_from_world: Rigid3, up_in_cams: np.ndarray | None) -> UpDirection | None:
    """Median measured direction; None if there is none, or most disagree with it."""
    if up_in_cams is None:
        return None
    known = np.isfinite(up_in_cams).all(axis=1)
    if not known.any():
        return None
    in_world = np.einsum("nji,nj->ni", cams_from_world.rotation[known], up_in_cams[known])
    median = np.median(in_world, axis=0)
    if np.linalg.norm(median) < MIN_AGREEMENT:
        return None
    median = median / np.linalg.norm(median)
    is_near = in_world @ median > np.cos(MAX_GRAVITY_ERROR_RAD)
    if is_near.mean() <= 0.5:
        return None
    mean = in_world[is_near].mean(axis=0)
    return UpDirection(mean / np.linalg.norm(mean), float(GRAVITY_SIGMA_RAD), True)


def _any_up(mean_y: np.ndarray) -> np.ndarray:
    size = float(np.linalg.norm(mean_y))
    return -mean_y / size if size > 0 else np.array([0.0, 0.0, 1.0])
