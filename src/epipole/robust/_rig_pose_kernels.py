"""Absolute pose from the rays of several cameras, or with a known vertical, for the robust loop.

Model, residual and refinement are those of `_absolute_pose_kernels`; only the minimal solver differs.
"""

import numpy as np

from epipole.robust._absolute_pose_kernels import RayPoseProblem
from epipole.robust._problem_kernels import Items
from epipole.solvers._linear_kernels import copy_numbers
from epipole.solvers._more_pose_kernels import generalized_p3p, generalized_p3p_workspace, upright_p2p


class RigPoseProblem(RayPoseProblem, Items):
    """Rays of several cameras."""

    __slots__ = ()

    def sample_size(self):
        return np.int64(3)

    def workspace(self):
        return (
            np.empty((3, 3)),
            np.empty((3, 3)),
            np.empty((3, 3)),
            np.empty((8, 13)),
            generalized_p3p_workspace(),
        )

    def solve_sample(self, sample, models, work):
        origins, rays, points, found, solver = work
        for k in range(3):
            for i in range(3):
                points[k, i], rays[k, i] = self.items[i, sample[k]], self.items[3 + i, sample[k]]
                origins[k, i] = self.items[12 + i, sample[k]]
        count = generalized_p3p(origins, rays, points, found, solver)
        for k in range(count):
            copy_numbers(found[k], models[k])
        return count

    def with_items(self, items):
        return RigPoseProblem(items)


class UprightPoseProblem(RayPoseProblem, Items):
    """Rays of one camera, o = 0; camera and world have a common y axis."""

    __slots__ = ()

    def sample_size(self):
        return np.int64(2)

    def workspace(self):
        return np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 12))

    def solve_sample(self, sample, models, work):
        rays, points, found = work
        for k in range(2):
            for i in range(3):
                points[k, i], rays[k, i] = self.items[i, sample[k]], self.items[3 + i, sample[k]]
        count = upright_p2p(rays, points, found)
        for k in range(count):
            copy_numbers(found[k], models[k])
        return count

    def with_items(self, items):
        return UprightPoseProblem(items)
