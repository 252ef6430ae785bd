"""Bundle adjustment of a stereo pair including the second camera's principal point; insignificant shifts are set to zero."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from epipole.optim import BundleConfig, BundleProblem, BundleResult, adjust_bundle

LEAST_SHIFT_PX = 0.1
"""Patch matches in the right image have a bias of hundredths of a pixel: on rendered pairs, whose principal points are known, it
was mistaken for a shift of 0.04 px, which made the trajectory 0.2 % too short."""


def adjust_pair(
    problem: BundleProblem, config: BundleConfig, goes_on: Callable[[], bool] = lambda: True
) -> tuple[BundleProblem, BundleResult]:
    """Adjust; if the second camera's free principal point barely moves, fix it and adjust again.

    Args:
        problem: in which all camera parameters except that principal point are fixed.
        config: of both adjustments.
        goes_on: asked after every step, which it ends by returning False; not asked while the principal point is free, since that
            is judged at the minimum.

    Returns:
        the problem that was adjusted last, and its minimum.
    """
    is_free = problem.params_free.any()
    result = adjust_bundle(problem, config, None if is_free else lambda _: goes_on())
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
    return fixed, adjust_bundle(fixed, config, lambda _: goes_on())
