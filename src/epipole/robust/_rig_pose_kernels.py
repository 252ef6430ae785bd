"""Absolute pose from the rays of several cameras, and from rays with a known vertical, for the robust loop.

Model, residual and refinement are those of `_absolute_pose_kernels`; only the minimal solver differs.
"""

from typing import NamedTuple

import numpy as np

from epipole.robust._absolute_pose_kernels import ABSOLUTE_POSE
from epipole.robust._contract_kernels import implement
from epipole.solvers._linear_kernels import copy_numbers
from epipole.solvers._more_pose_kernels import generalized_p3p, generalized_p3p_workspace, upright_p2p


class RigPoseProblem(NamedTuple):
    """Rays of several cameras."""

    items: np.ndarray
    """(15, n): X, d, J0, J1, o."""


class UprightPoseProblem(NamedTuple):
    """Rays of one camera; the y axes of camera and world are one."""

    items: np.ndarray
    """(15, n): X, d, J0, J1, o = 0."""


def _rig_workspace(problem):
    return (
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((8, 13)),
        generalized_p3p_workspace(),
    )


def _solve_rig_sample(problem, sample, models, work):
    origins, rays, points, found, solver = work
    for k in range(3):
        for i in range(3):
            points[k, i], rays[k, i] = problem.items[i, sample[k]], problem.items[3 + i, sample[k]]
            origins[k, i] = problem.items[12 + i, sample[k]]
    count = generalized_p3p(origins, rays, points, found, solver)
    for k in range(count):
        copy_numbers(found[k], models[k])
    return count


def _upright_workspace(problem):
    return np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 12))


def _solve_upright_sample(problem, sample, models, work):
    rays, points, found = work
    for k in range(2):
        for i in range(3):
            points[k, i], rays[k, i] = problem.items[i, sample[k]], problem.items[3 + i, sample[k]]
    count = upright_p2p(rays, points, found)
    for k in range(count):
        copy_numbers(found[k], models[k])
    return count


def _two(problem):
    return np.int64(2)


implement(RigPoseProblem, **{**ABSOLUTE_POSE, "workspace": _rig_workspace, "solve_sample": _solve_rig_sample})
implement(
    UprightPoseProblem,
    **{
        **ABSOLUTE_POSE,
        "sample_size": _two,
        "workspace": _upright_workspace,
        "solve_sample": _solve_upright_sample,
    },
)
