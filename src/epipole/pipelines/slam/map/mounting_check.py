"""Check the given orientations of a rig's cameras against the images: bundle adjustment of the finished map with free orientations.

A wrong orientation bends the map and changes its size, while most of its points still fit: those that do not are removed as outliers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from epipole.geometry import Rotation3
from epipole.optim import BundleConfig, Loss, adjust_bundle
from epipole.pipelines.slam.map.local_mapping import LocalMapper
from epipole.scene import CameraRig

LARGEST_DEG, LARGEST_PX = 0.1, 0.25
"""Tolerated rotation: the larger of an angle and a shift of the image. On rendered rigs with exact calibrations it was at most 0.025
degrees, and 0.17 px with images of 240 x 180; a pair 12 cm apart that is 0.3 degrees off makes the trajectory of a round through a room
wrong by 8 cm."""
LEAST_KEYFRAMES, LEAST_OBSERVATIONS = 5, 200
"""Fewest keyframes of the map, and observations of a camera that is judged."""
MAX_ITERATIONS = 20


@dataclass(frozen=True, slots=True)
class MountingCheck:
    """Rotations between the given orientations of the cameras and those that fit the images best."""

    rotation_deg: tuple[float, ...]
    """Of each camera relative to the first one, which is the reference; zero for those with too few observations."""
    tolerance_deg: tuple[float, ...]
    """Largest rotation of each camera that is not reported."""

    def warnings(self) -> list[str]:
        """Warnings about wrong orientations."""
        return [
            f"the images fit an orientation of camera {k} better that is {angle:.2f} degrees from the calibration (relative to camera"
            " 0): the map is bent, and its size is wrong. Calibrate the poses of the cameras on the rig, and check the order of the"
            " folders"
            for k, (angle, tolerance) in enumerate(zip(self.rotation_deg, self.tolerance_deg))
            if angle > tolerance
        ]


def check_mounting(mapper: LocalMapper) -> MountingCheck | None:
    """Estimate the orientations of a rig's cameras in the finished map; None for a single camera, a small map, or a first camera that sees too little."""
    if not isinstance(mapper.camera, CameraRig):
        return None
    problem = mapper.problem_of(range(len(mapper.map.keyframes)))
    if problem is None or len(problem.frame_free) < LEAST_KEYFRAMES:
        return None
    counts = np.bincount(problem.sensor, minlength=len(problem.cam_from_rig))
    if counts[0] < LEAST_OBSERVATIONS:  # the others would be compared with a camera that no image determines
        return None
    free = np.zeros((len(counts), 6))
    free[counts >= LEAST_OBSERVATIONS, 3:] = 1.0
    free[0] = 0.0
    config = BundleConfig(loss=Loss.CAUCHY, loss_scale_px=1.0, max_iterations=MAX_ITERATIONS)
    found = adjust_bundle(replace(problem, sensor_free=free), config).cam_from_rig
    between = Rotation3(found.rotation @ np.swapaxes(problem.cam_from_rig.rotation, 1, 2)).angle_rad()
    pixel_deg = [math.degrees(1.0 / camera.focal_px) for camera in mapper.camera.cameras]
    tolerance = tuple(max(LARGEST_DEG, LARGEST_PX * one) for one in pixel_deg)
    return MountingCheck(tuple(np.degrees(between).tolist()), tolerance)
