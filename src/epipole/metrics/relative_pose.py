"""Relative rotations and translation directions of all image pairs, and areas under recall curves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from epipole._checks import as_float_array, checked
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3, Rotation3


@checked
def relative_pose_auc(
    estimated: Rigid3,
    truth: Rigid3,
    registered_mask: Bool[np.ndarray, " n"],
    thresholds_deg: Sequence[float] = (1.0, 3.0, 5.0),
) -> Float64[np.ndarray, " t"]:
    """Area under the recall curve of the relative pose error over all pairs of images, one value per threshold.

    A pair's error is the larger of its rotation error and its translation direction error. A pair with an unregistered image has
    an infinite error, so missing images cost as much as wrong ones. There is no alignment.

    Args:
        estimated: cams_from_world of the estimate; rows outside the mask are ignored.
        truth: cams_from_world of the truth, in the same order, all known.
        registered_mask: images that the estimate contains.
        thresholds_deg: upper limits of the recall curves.

    Raises:
        ShapeError: the batches differ, or there are fewer than two images.
    """
    return area_under_recall(relative_pose_errors_deg(estimated, truth, registered_mask), thresholds_deg)


@checked
def relative_pose_errors_deg(
    estimated: Rigid3, truth: Rigid3, registered_mask: Bool[np.ndarray, " n"]
) -> Float64[np.ndarray, " p"]:
    """max(rotation error, translation direction error) of every pair i < j; infinite if an image is missing.

    Pairs whose true positions coincide have no direction, so only their rotation counts. An estimate that merges two distinct
    positions gets 180 degrees.

    Raises:
        ShapeError: the batches differ, or there are fewer than two images.
    """
    n = len(registered_mask)
    if estimated.translation.shape != (n, 3) or truth.translation.shape != (n, 3) or n < 2:
        raise ShapeError(
            f"estimated, truth and registered_mask must have the same n >= 2 images, got "
            f"{estimated.translation.shape[:-1]}, {truth.translation.shape[:-1]} and ({n},)"
        )
    first, second = np.triu_indices(n, k=1)
    errors_deg = np.full(len(first), np.inf)
    both = registered_mask[first] & registered_mask[second]
    i, j = first[both], second[both]
    guess, true = estimated[j] @ estimated[i].inverse(), truth[j] @ truth[i].inverse()
    rotation = (Rotation3(guess.rotation) @ Rotation3(true.rotation).inverse()).angle_rad()
    direction = _direction_errors_rad(guess.translation, true.translation)
    errors_deg[both] = np.degrees(np.maximum(rotation, direction))
    return errors_deg


@checked
def area_under_recall(errors: Any, thresholds: Sequence[float]) -> Float64[np.ndarray, " t"]:
    """Area under recall(error) from 0 to each threshold, divided by the threshold, by the trapezoidal rule.

    The curve passes through (0, 0) and (k-th smallest error, k / n), and is constant from the last error below the threshold to the
    threshold, as in relative pose benchmarks (Sarlin et al., SuperGlue, CVPR 2020).

    Args:
        errors: (n,) non-negative; infinite for failures.
        thresholds: positive, in the unit of the errors.

    Raises:
        ConfigError: a threshold is not positive and finite.
        ShapeError: there are no errors, or one is NaN.
    """
    errors = np.sort(as_float_array(errors, "errors").ravel())
    if len(errors) == 0 or np.isnan(errors).any():
        raise ShapeError("errors must be a non-empty array without NaN")
    if not all(0 < threshold < np.inf for threshold in thresholds):
        raise ConfigError(f"thresholds must be positive and finite, got {thresholds}")
    recall = np.arange(len(errors) + 1) / len(errors)
    areas = []
    for threshold in thresholds:
        below = int(np.searchsorted(errors, threshold))
        x = np.concatenate([[0.0], errors[:below], [threshold]])
        y = np.append(recall[: below + 1], recall[below])
        areas.append(np.trapezoid(y, x) / threshold)
    return np.array(areas)


def _direction_errors_rad(guess: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Angles between translations; 0 where the true one is zero, pi where only the estimated one is."""
    angles = np.arctan2(np.linalg.norm(np.cross(guess, true), axis=1), (guess * true).sum(axis=1))
    guess_length, true_length = np.linalg.norm(guess, axis=1), np.linalg.norm(true, axis=1)
    angles[guess_length <= 1e-9 * guess_length.max(initial=0.0)] = np.pi
    angles[true_length <= 1e-9 * true_length.max(initial=0.0)] = 0.0
    return angles
