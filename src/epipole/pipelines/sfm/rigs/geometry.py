"""Relative poses of the cameras of a rig, in a model whose images were mapped one by one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from epipole.geometry import Rigid3, Rotation3
from epipole.pipelines.sfm.rigs.assignment import RigAssignment

MIN_FRAMES = 3
"""Frames in which a sensor and the reference are registered, so that their relative pose can be estimated."""
MAX_ROTATION_RAD = np.deg2rad(3.0)
"""Median deviation of the relative rotations, from their mean or the given one, above which they contradict the rig."""
MAX_DIRECTION_RAD = np.deg2rad(15.0)
"""Median deviation of the direction between two cameras above which it contradicts the given one."""
MAX_SPREAD = 0.3
"""Median deviation of the distance between two cameras, relative to it, above which the geometry is not constant."""

NEGLIGIBLE = 0.01
"""Variation of a relative position, relative to the extent of the cameras, that is the noise of poses mapped one by one."""


@dataclass(frozen=True, slots=True, eq=False)
class RelativePoses:
    """Poses of a sensor relative to the reference of its rig, one for each frame with both."""

    sensor: int
    cam_from_reference: Rigid3

    def __len__(self) -> int:
        return len(self.cam_from_reference.translation)


def relative_poses(cams_from_world: Rigid3, assignment: RigAssignment, sensor: int) -> RelativePoses:
    """Relative poses of a sensor in the frames in which it and the reference are registered."""
    reference = assignment.reference_of(sensor)
    known = np.isfinite(cams_from_world.translation).all(axis=1)
    of_frame = {int(assignment.frame[k]): k for k in np.flatnonzero((assignment.sensor == reference) & known)}
    pairs = [
        (int(k), of_frame[int(assignment.frame[k])])
        for k in np.flatnonzero((assignment.sensor == sensor) & known)
        if int(assignment.frame[k]) in of_frame
    ]
    mine, theirs = np.array([a for a, _ in pairs], np.int64), np.array([b for _, b in pairs], np.int64)
    return RelativePoses(sensor, cams_from_world[mine] @ cams_from_world[theirs].inverse())


def robust_mean(motions: Rigid3) -> Rigid3:
    """The mean of the motions that are near the median one: rotations by projection of their sum, translations by their median."""
    rotation = Rotation3.nearest(motions.rotation.sum(axis=0)).matrix
    for _ in range(3):
        off = rotation_angles_rad(motions.rotation, rotation)
        near = off <= 2.0 * max(float(np.median(off)), 1e-9)
        rotation = Rotation3.nearest(motions.rotation[near].sum(axis=0)).matrix
    return Rigid3(rotation, np.median(motions.translation, axis=0))


def rotation_angles_rad(
    rotations: Float64[np.ndarray, "n 3 3"], reference: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, " n"]:
    """Angle between each rotation and another one."""
    trace = np.einsum("nij,ij->n", rotations, reference)
    return np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0))


def contradiction_of(found: RelativePoses, given: Rigid3) -> str:
    """How the relative poses contradict the given one; empty if they do not, or are too few."""
    if len(found) < MIN_FRAMES:
        return ""
    poses = found.cam_from_reference
    angle = float(np.median(rotation_angles_rad(poses.rotation, given.rotation)))
    if angle > MAX_ROTATION_RAD:
        return f"the images show a rotation that differs by {np.degrees(angle):.1f} degrees (median)"
    measured, expected = poses.translation, given.translation
    length = np.linalg.norm(measured, axis=1) * np.linalg.norm(expected)
    if np.linalg.norm(expected) > 0 and (length > 0).all():
        off = np.arccos(np.clip(measured @ expected / length, -1.0, 1.0))
        if float(np.median(off)) > MAX_DIRECTION_RAD:
            return f"the images show a translation in another direction, by {np.degrees(np.median(off)):.0f} degrees (median)"
    return ""


def inconstancy_of(found: RelativePoses, extent: float) -> str:
    """Why the relative poses are not those of a rigid rig; empty if they are.

    Args:
        found: the relative poses.
        extent: extent of the cameras, relative to which small variations do not matter.
    """
    if len(found) < MIN_FRAMES:
        return f"only {len(found)} frames have it and the reference, at least {MIN_FRAMES} are needed"
    mean, poses = robust_mean(found.cam_from_reference), found.cam_from_reference
    angle = float(np.median(rotation_angles_rad(poses.rotation, mean.rotation)))
    if angle > MAX_ROTATION_RAD:
        return f"its rotation relative to the reference varies by {np.degrees(angle):.1f} degrees (median)"
    spread = float(np.median(np.linalg.norm(poses.translation - mean.translation, axis=1)))
    if spread > max(MAX_SPREAD * float(np.linalg.norm(mean.translation)), NEGLIGIBLE * extent):
        return "its position relative to the reference varies"
    return ""
