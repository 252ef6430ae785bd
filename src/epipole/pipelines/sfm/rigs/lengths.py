"""The scale that known distances between the cameras of rigs give, and what contradicts it: each other, or a scale known otherwise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from epipole.pipelines.sfm.rigs.geometry import RelativePoses
from epipole.scale import ScaleEstimate

LENGTH_TOLERANCE, SCALE_TOLERANCE, AGREE = 0.1, 0.02, 4.0
"""Distances contradict each other if their ratios differ by more than this fraction and number of standard deviations; so do two scales."""
LONE_SIGMA = 0.05
"""Relative standard deviation of a ratio from a single frame."""
CALIBRATION_SIGMA = 0.002
"""Relative standard deviation of given baselines and focal lengths: half a millimeter of 25 cm, or a focal length that is off by 0.2 %."""


@dataclass(frozen=True, slots=True, eq=False)
class RigScale:
    """Meters per unit of a model, from the known distances between cameras."""

    factor: float
    sigma: float
    """Relative standard deviation, of the poses mapped one by one."""
    num_frames: int
    """Frames that measure it, counted once for each distance."""


def length_ratios(found: RelativePoses, known: float) -> Float64[np.ndarray, " n"]:
    """Known distance from the reference over the distance in the model, for each frame with both."""
    length = np.linalg.norm(found.cam_from_reference.translation, axis=1)
    return known / length[length > 0] if known > 0 else np.zeros(0)


def contradictory_lengths(ratios: Mapping[int, Float64[np.ndarray, " n"]]) -> dict[int, str]:
    """Sensors whose given distance contradicts those of the others, and how.

    The median over the sensors decides: of two distances that contradict each other, both are named.

    Args:
        ratios: of `length_ratios`, by sensor.
    """
    middles = {s: float(np.median(np.log(own))) for s, own in ratios.items() if len(own)}
    if len(middles) < 2:
        return {}
    middle, out = float(np.median(list(middles.values()))), {}
    for s, own in middles.items():
        if abs(own - middle) > max(np.log1p(LENGTH_TOLERANCE), AGREE * _sigma(ratios[s])):
            out[s] = (
                f"the images show {np.exp(middle - own):.2f} times the given distance from the reference, compared with the "
                "other given distances"
            )
    return out


def scale_of_lengths(ratios: Mapping[int, Float64[np.ndarray, " n"]]) -> RigScale | None:
    """The median ratio of all frames; None without any."""
    every = np.concatenate([np.zeros(0), *ratios.values()])
    return RigScale(float(np.median(every)), _sigma(every), len(every)) if len(every) else None


def contradiction_of_scales(found: RigScale, other: ScaleEstimate) -> str:
    """How the scale of the rigs contradicts another one of the same model, which is in meters by that; empty if it does not."""
    sigma = float(np.sqrt(found.sigma**2 + other.fraction**2 + CALIBRATION_SIGMA**2))
    if abs(np.log(found.factor)) <= max(np.log1p(SCALE_TOLERANCE), AGREE * sigma):
        return ""
    return (
        f"the rigs are not used: by the distances between their cameras, the model is {found.factor:.3g} times as large as by "
        f"{other.note or other.name} (known to {100 * other.fraction:.2g} %); distances in a rig file are in meters"
    )


def _sigma(ratios: Float64[np.ndarray, " n"]) -> float:
    """Standard deviation of the logarithm of the median ratio: that of the mean, times sqrt(pi / 2)."""
    if len(ratios) < 2:
        return LONE_SIGMA
    logs = np.log(ratios)
    spread = 1.4826 * float(np.median(np.abs(logs - np.median(logs))))
    return float(np.sqrt(0.5 * np.pi / len(ratios))) * spread
