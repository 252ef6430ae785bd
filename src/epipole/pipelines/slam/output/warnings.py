"""Warnings of a finished run: poor images, moving objects, a camera at rest."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from epipole.pipelines.slam.frames import TrackedFrame
from epipole.pipelines.slam.tracking.static_points import CAMERA_AT_REST, MOVES_ALONG
from epipole.scene import Trajectory

_IMAGE = re.compile(r"the (?:left |right )?image is (?:blurred|dark|overexposed|of one shade)")
LEAST_MOVING = 5
"""Number of frames with a moving object from which on a warning is given ..."""
MOVING_FRACTION = 0.05
"""... if they are also this fraction of all frames."""
REST_SIGMAS = 4.0
"""A camera that stays within this many standard deviations of its first position counts as at rest."""
LEAST_RESTING, MOST_REST_DEG = 5, 0.5
LEAST_RESTED = 3
"""Number of frames with a static part assumed to be the scene from which on a warning is given."""


def poor_images(tracked: Sequence[TrackedFrame]) -> dict[str, int]:
    """Number of frames with a blurred, dark, ... image, by the wording of the reason."""
    return dict(Counter(words for frame in tracked for words in _IMAGE.findall(frame.reason)))


def moving_things(tracked: Sequence[TrackedFrame]) -> dict[str, Any] | None:
    """Number of frames with a moving object, and the frame with most of its points; None if there are none."""
    seen = [(row, frame.moving) for row, frame in enumerate(tracked) if frame.moving is not None]
    if not seen:
        return None
    row, most = max(seen, key=lambda pair: pair[1].num_points)
    return {
        "num_frames": len(seen),
        "most_points": most.num_points,
        "at_s": tracked[row].timestamp_s,
        "low_px": list(most.low_px),
        "high_px": list(most.high_px),
    }


def rest(path: Trajectory) -> str:
    """Warning if the camera moved no further than its position uncertainty; else empty."""
    if len(path) < LEAST_RESTING or path.covariance is None:
        return ""
    positions = path.world_from_body
    furthest = float(np.linalg.norm(positions.translation - positions.translation[0], axis=1).max())
    variance = np.trace(path.covariance[:, :3, :3], axis1=1, axis2=2)
    known = variance[np.isfinite(variance) & (variance > 0)]
    if furthest > (REST_SIGMAS * np.sqrt(float(np.median(known))) if len(known) else 0.0):
        return ""
    rotations_deg = np.degrees(
        np.linalg.norm((positions.inverse() @ positions[0]).log()[:, 3:], axis=1).max()
    )
    if rotations_deg > MOST_REST_DEG:
        return f"the camera only rotates, by up to {rotations_deg:.3g} degrees: no position differs from the first"
    return f"the camera is at rest: it stays within {furthest:.2g} of its first position and {rotations_deg:.2g} degrees of its first orientation"


def warnings(tracked: Sequence[TrackedFrame], path: Trajectory) -> list[str]:
    """Warnings about images, moving objects and a camera at rest."""
    out = [f"in {count} of {len(tracked)} frames {words}" for words, count in poor_images(tracked).items()]
    moving = moving_things(tracked)
    if moving and moving["num_frames"] >= max(LEAST_MOVING, MOVING_FRACTION * len(tracked)):
        (left, top), (right, bottom) = moving["low_px"], moving["high_px"]
        out.append(
            f"an object moves in {moving['num_frames']} of {len(tracked)} frames (at most"
            f" {moving['most_points']} points, at {moving['at_s']:.2f} s in columns {left:.0f} to {right:.0f}, rows"
            f" {top:.0f} to {bottom:.0f}): its points are not used"
        )
    for assumed, least in (
        (CAMERA_AT_REST, LEAST_RESTED),
        (MOVES_ALONG, max(LEAST_MOVING, MOVING_FRACTION * len(tracked))),
    ):
        if (count := sum(assumed in frame.reason for frame in tracked)) >= least:
            out.append(
                f"in {count} of {len(tracked)} frames part of the image is static while the rest moves: {assumed}; images alone"
                " cannot distinguish the two"
            )
    return [*out, words] if (words := rest(path)) else out
