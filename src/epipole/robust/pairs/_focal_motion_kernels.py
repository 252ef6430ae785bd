"""Relative pose with unknown focal lengths, for the robust loop.

Model: F (9), of any length; R row by row (9:18), t (18:21), f1, f2 (21, 22); then the sign of the lines and the epipole, as
for fundamental matrices, whose score is used. F = D2 [t]x R D1 with D = diag(1, 1, f), for pixels relative to the principal
points, in units of the image spread.
"""

import math

import numpy as np

from epipole._jit import kernel
from epipole.robust._item_kernels import gather, rotate_left
from epipole.robust._problem_kernels import Items
from epipole.robust.pairs._fundamental_kernels import (
    EPIPOLE,
    SENSE,
    EpipolarProblem,
    find_epipole,
    line_sense,
)
from epipole.robust.pairs._relative_pose_kernels import derivatives_of_essential, tangent_of_direction
from epipole.solvers._focal_motion_kernels import (
    focals_from_fundamental,
    shared_focal_six_point,
    shared_focal_workspace,
)
from epipole.solvers._two_view_kernels import (
    essential_from_motion,
    fundamental_seven_point,
    motions_from_essential,
    seven_point_workspace,
)

MOTION, FOCAL1, FOCAL2 = 9, 21, 22
LEAST_FOCAL, MOST_FOCAL = 0.1, 20.0


@kernel(allocates=True)
def _compose(model):
    """F, and its epipole with the previous sign, from the motion and the focal lengths."""
    e, before = np.empty(9), np.empty(3)
    essential_from_motion(model[MOTION : MOTION + 12], e)
    for i in range(3):
        before[i] = model[EPIPOLE + i]
        for j in range(3):
            scale = (model[FOCAL2] if i == 2 else 1.0) * (model[FOCAL1] if j == 2 else 1.0)
            model[3 * i + j] = e[3 * i + j] * scale
    if not find_epipole(model):
        return False
    along = 0.0
    for i in range(3):
        along += before[i] * model[EPIPOLE + i]
    if along < 0.0:
        for i in range(3):
            model[EPIPOLE + i] = -model[EPIPOLE + i]
    return True


@kernel(allocates=True)
def _derivatives(model, shared, d):
    """D (6 or 7, 9): derivatives of the entries of F by rotation, direction and log focal lengths."""
    motion = model[MOTION : MOTION + 12]
    derivatives_of_essential(motion, d)
    for c in range(5):
        for i in range(3):
            for j in range(3):
                scale = (model[FOCAL2] if i == 2 else 1.0) * (model[FOCAL1] if j == 2 else 1.0)
                d[c, 3 * i + j] *= scale
    for i in range(3):
        for j in range(3):
            k = 3 * i + j
            by_first, by_second = (model[k] if j == 2 else 0.0), (model[k] if i == 2 else 0.0)
            if shared:
                d[5, k] = by_first + by_second
            else:
                d[5, k], d[6, k] = by_first, by_second


@kernel(allocates=True)
def _retract_focal_motion(model, delta, shared, out):
    basis = np.empty((2, 3))
    rotate_left(delta, model[9:18], out[9:18])
    tangent_of_direction(model[18:21], basis)
    norm = 0.0
    for i in range(3):
        out[18 + i] = model[18 + i] + delta[3] * basis[0, i] + delta[4] * basis[1, i]
        norm += out[18 + i] ** 2
    norm = 1.0 / math.sqrt(norm)
    for i in range(3):
        out[18 + i] *= norm
    second = delta[5] if shared else delta[6]
    out[FOCAL1] = model[FOCAL1] * math.exp(min(max(delta[5], -0.5), 0.5))
    out[FOCAL2] = model[FOCAL2] * math.exp(min(max(second, -0.5), 0.5))
    _compose(out)


@kernel(allocates=True)
def _add_motions(x1, x2, essential, f1, f2, models, count):
    """Append the motions of E that put the sample in front and have consistent line orientations."""
    y1, y2, motions = x1.copy(), x2.copy(), np.empty((4, 12))
    for k in range(len(x1)):
        for c in range(2):
            y1[k, c] /= f1
            y2[k, c] /= f2
    for c in range(motions_from_essential(essential, y1, y2, motions)):
        if count == len(models):
            break
        model = models[count]
        for i in range(12):
            model[MOTION + i] = motions[c, i]
        model[FOCAL1], model[FOCAL2] = f1, f2
        if not _compose(model):
            continue
        sense = line_sense(model, x1[0], x2[0])
        agree = True
        for k in range(1, len(x1)):
            agree = agree and sense * line_sense(model, x1[k], x2[k]) > 0.0
        if agree:
            model[SENSE] = 1.0 if sense > 0.0 else -1.0
            count += 1
    return count


class SharedFocalProblem(EpipolarProblem, Items):
    """One focal length for both cameras: six points."""

    __slots__ = ()

    def sample_size(self):
        return np.int64(6)

    def degrees_of_freedom(self):
        return np.int64(6)

    def workspace(self):
        return np.empty((6, 3)), np.empty((6, 3)), np.empty((8, 9)), np.empty(8), shared_focal_workspace()

    def solve_sample(self, sample, models, work):
        x1, x2, essentials, focals, solver = work
        gather(self.items, sample, x1, x2)
        count = np.int64(0)
        for k in range(shared_focal_six_point(x1, x2, essentials, focals, solver)):
            count = _add_motions(x1, x2, essentials[k], focals[k], focals[k], models, count)
        return count

    def derivatives(self, model, d):
        _derivatives(model, True, d)

    def retract(self, model, delta, out):
        _retract_focal_motion(model, delta, True, out)

    def with_items(self, items):
        return SharedFocalProblem(items)


class TwoFocalsProblem(EpipolarProblem, Items):
    """A focal length for each camera: seven points, and the focal lengths of the fundamental matrix."""

    __slots__ = ()

    def sample_size(self):
        return np.int64(7)

    def degrees_of_freedom(self):
        return np.int64(7)

    def workspace(self):
        return np.empty((7, 3)), np.empty((7, 3)), np.empty((3, 9)), np.empty(9), seven_point_workspace()

    def solve_sample(self, sample, models, work):
        x1, x2, found, essential, solver = work
        gather(self.items, sample, x1, x2)
        count = np.int64(0)
        for k in range(fundamental_seven_point(x1, x2, found, solver)):
            f1, f2 = focals_from_fundamental(found[k])
            if not (f1 > LEAST_FOCAL and f1 < MOST_FOCAL and f2 > LEAST_FOCAL and f2 < MOST_FOCAL):
                continue
            for i in range(3):
                for j in range(3):
                    scale = (f2 if i < 2 else 1.0) * (f1 if j < 2 else 1.0)
                    essential[3 * i + j] = scale * found[k, 3 * i + j]
            count = _add_motions(x1, x2, essential, f1, f2, models, count)
        return count

    def derivatives(self, model, d):
        _derivatives(model, False, d)

    def retract(self, model, delta, out):
        _retract_focal_motion(model, delta, False, out)

    def with_items(self, items):
        return TwoFocalsProblem(items)
