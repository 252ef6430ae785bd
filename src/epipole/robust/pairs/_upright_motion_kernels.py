"""Relative pose of two cameras with a known vertical, for the robust loop.

Model, residual and refinement are those of `_relative_pose_kernels`: only the minimal solver uses the vertical, so an error
of a degree costs samples but no accuracy.
"""

from typing import NamedTuple

import numpy as np

from epipole.robust._item_kernels import gather
from epipole.robust.pairs._relative_pose_kernels import MATRIX, PlaneMotionProblem
from epipole.solvers._linear_kernels import copy_numbers
from epipole.solvers._more_pose_kernels import upright_relative_three_point, upright_relative_workspace
from epipole.solvers._two_view_kernels import essential_from_motion, is_in_front


class UprightItems(NamedTuple):
    """Matches and verticals."""

    items: np.ndarray
    """(4, n), matches on the planes z = 1."""
    upright1: np.ndarray
    """(3, 3), upright_from_cam1: rotates rays to an upright frame."""
    upright2: np.ndarray


class UprightMotionProblem(PlaneMotionProblem, UprightItems):
    """Matches on the planes z = 1, and the rotations to upright frames."""

    __slots__ = ()

    def sample_size(self):
        return np.int64(3)

    def workspace(self):
        x1, x2, y1, y2 = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
        return x1, x2, y1, y2, np.empty((12, 12)), np.empty((3, 3)), upright_relative_workspace()

    def solve_sample(self, sample, models, work):
        x1, x2, y1, y2, found, rotated, solver = work
        u1, u2 = self.upright1, self.upright2
        gather(self.items, sample, x1, x2)
        for k in range(3):
            for i in range(3):
                y1[k, i] = u1[i, 0] * x1[k, 0] + u1[i, 1] * x1[k, 1] + u1[i, 2] * x1[k, 2]
                y2[k, i] = u2[i, 0] * x2[k, 0] + u2[i, 1] * x2[k, 1] + u2[i, 2] * x2[k, 2]
        count = 0
        for k in range(upright_relative_three_point(y1, y2, found, solver)):
            in_front = True
            for i in range(3):
                in_front = in_front and is_in_front(found[k], y1[i], y2[i])
            if not in_front:
                continue
            # R = upright2^T R_y upright1, t = upright2^T t_y.
            for i in range(3):
                for j in range(3):
                    rotated[i, j] = 0.0
                    for c in range(3):
                        rotated[i, j] += found[k, 3 * i + c] * u1[c, j]
            for i in range(3):
                models[count, 9 + i] = 0.0
                for c in range(3):
                    models[count, 9 + i] += u2[c, i] * found[k, 9 + c]
                for j in range(3):
                    models[count, 3 * i + j] = (
                        u2[0, i] * rotated[0, j] + u2[1, i] * rotated[1, j] + u2[2, i] * rotated[2, j]
                    )
            essential_from_motion(models[count], models[count, MATRIX : MATRIX + 9])
            count += 1
        return count

    def refine(self, sample, model, refined, work):
        copy_numbers(model, refined[0])
        return np.int64(1)

    def with_items(self, items):
        return UprightMotionProblem(items, self.upright1, self.upright2)
