"""A pair of cameras, adjusted with the second one's principal point; a shift that is too small to be told is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from epipole.optim import BundleConfig, BundleProblem, BundleResult, adjust_bundle

LEAST_SHIFT_PX = 0.1
"""Places in the right image that patches are found at are off by hundredths of a pixel, all to one side: on rendered pairs,
whose principal points are known, shifts of 0.04 px were found, and made the path 0.2 % too short."""


def adjust_pair(problem: BundleProblem, config: BundleConfig) -> tuple[BundleProblem, BundleResult]:
    """Adjust; where the second camera's principal point is free and is found to be all but where it was said, once more without.

    Args:
        problem: in which parameters other than that one are held.
        config: of both adjustments.

    Returns:
        what was adjusted last, and its minimum.
    """
    result = adjust_bundle(problem, config)
    if not problem.params_free.any() or problem.priors is None or problem.priors.params_expected is None:
        return problem, result
    said = problem.priors.params_expected
    if np.abs(result.camera_params - said).max() >= LEAST_SHIFT_PX:
        return problem, result
    fixed = replace(
        problem,
        rig_from_world=result.rig_from_world,
        points_in_world=result.points_in_world,
        camera_params=said.copy(),
        params_free=np.zeros_like(problem.params_free),
        priors=replace(problem.priors, params_expected=None, params_sigma=None),
    )
    return fixed, adjust_bundle(fixed, config)
