"""The one LO-RANSAC loop, and what each estimation problem tells it.

A problem is a NamedTuple; its type selects, at compile time, the six functions of the contract:
    sample_size(p)                       matches in a minimal sample
    solve_sample(p, sample, models)      minimal solver; writes models, returns their number
    score(p, model, bail_out)            MSAC score, lower is better
    residuals_sq(p, model, out)          squared residual of every match
    linearize(p, model, a, b)            Gauss-Newton terms of the truncated loss; returns the score
    retract(p, model, delta, out)        the model moved by a step
The loop knows nothing else (the form is PoseLib's; the method Chum, Matas, Kittler, DAGM 2003, with the
truncated least squares of Lebeda, Matas, Chum, BMVC 2012 as its local step).
"""

import math
from inspect import signature
from typing import NamedTuple

import numpy as np
from numba import types
from numba.extending import overload

from epipole._jit import SAFE_FASTMATH, kernel
from epipole.robust import _score_kernels as s
from epipole.solvers._absolute_pose_kernels import p3p, p3p_workspace
from epipole.solvers._linear_kernels import solve_spd
from epipole.solvers._two_view_kernels import (
    essential_five_point,
    essential_from_motion,
    five_point_workspace,
    fundamental_seven_point,
    homography_four_point,
    motions_from_essential,
    seven_point_workspace,
    svd3,
)

# Whole numbers are passed as np.int64: Numba compiles a function anew for every literal one.
LOCAL_STEPS, FINAL_STEPS = 10, 30
SAFETY = 2.0  # samples drawn per sample needed: a sample of inliers may still be a poor one
MODEL_SIZE = 28  # room for the largest model: F (9), U (9), V (9), ratio of singular values


class EssentialProblem(NamedTuple):
    """Model: motion (R row by row, t), |t| = 1. Matches on the plane z = 1."""

    matches: np.ndarray  # (4, n)
    threshold_sq: float


class FundamentalProblem(NamedTuple):
    """Model: F (9), then U, V, s1 / s0 of its singular value decomposition. Matches of order one."""

    matches: np.ndarray
    threshold_sq: float


class HomographyProblem(NamedTuple):
    """Model: H (9). Matches of order one."""

    matches: np.ndarray
    threshold_sq: float


class AbsolutePoseProblem(NamedTuple):
    """Model: motion (R row by row, t) = cam_from_world. Errors are pixels of the true camera model."""

    points: np.ndarray  # (3, n)
    rays: np.ndarray  # (n, 3), unit
    pixels: np.ndarray  # (2, n)
    camera_model: int
    camera_params: np.ndarray  # (8,)
    threshold_sq: float


def sample_size(problem): ...
def num_items(problem): ...
def degrees_of_freedom(problem): ...
def workspace(problem): ...
def solve_sample(problem, sample, models, work): ...
def score(problem, model, bail_out): ...
def residuals_sq(problem, model, out): ...
def linearize(problem, model, a, b): ...
def retract(problem, model, delta, out): ...


def _specialize(function, **implementations):
    """Register an implementation per problem type: at compile time the type of `problem` selects it."""

    def choose(problem, *_):
        if isinstance(problem, types.BaseNamedTuple):
            return implementations.get(problem.instance_class.__name__)
        return None

    # Numba wants the chooser's parameters to be named as the function's.
    names = signature(function).parameters
    scope = {"choose": choose}
    exec(f"def chooser({', '.join(names)}): return choose({', '.join(names)})", scope)
    overload(function, jit_options={"error_model": "numpy", "fastmath": SAFE_FASTMATH})(scope["chooser"])


_specialize(
    sample_size,
    EssentialProblem=lambda problem: np.int64(5),
    FundamentalProblem=lambda problem: np.int64(7),
    HomographyProblem=lambda problem: np.int64(4),
    AbsolutePoseProblem=lambda problem: np.int64(3),
)
_specialize(
    num_items,
    EssentialProblem=lambda problem: problem.matches.shape[1],
    FundamentalProblem=lambda problem: problem.matches.shape[1],
    HomographyProblem=lambda problem: problem.matches.shape[1],
    AbsolutePoseProblem=lambda problem: problem.points.shape[1],
)
_specialize(
    degrees_of_freedom,
    EssentialProblem=lambda problem: np.int64(5),
    FundamentalProblem=lambda problem: np.int64(7),
    HomographyProblem=lambda problem: np.int64(9),
    AbsolutePoseProblem=lambda problem: np.int64(6),
)
_specialize(
    workspace,
    EssentialProblem=lambda problem: five_point_workspace(),
    FundamentalProblem=lambda problem: seven_point_workspace(),
    HomographyProblem=lambda problem: (np.empty(1),),
    AbsolutePoseProblem=lambda problem: p3p_workspace(),
)


@kernel
def _gather(matches, sample, x1, x2):
    for k in range(len(x1)):
        x1[k, 0], x1[k, 1], x1[k, 2] = matches[0, sample[k]], matches[1, sample[k]], 1.0
        x2[k, 0], x2[k, 1], x2[k, 2] = matches[2, sample[k]], matches[3, sample[k]], 1.0


@kernel(allocates=True)
def _solve_essential(matches, sample, models, work):
    y1, y2, essentials, motions = np.empty((5, 3)), np.empty((5, 3)), np.empty((10, 9)), np.empty((4, 12))
    _gather(matches, sample, y1, y2)
    count = 0
    for k in range(essential_five_point(y1, y2, essentials, work)):
        for c in range(motions_from_essential(essentials[k], y1, y2, motions)):
            if count < len(models):
                models[count, :12] = motions[c]
                count += 1
    return count


@kernel(allocates=True)
def _solve_fundamental(matches, sample, models, work):
    x1, x2, found = np.empty((7, 3)), np.empty((7, 3)), np.empty((3, 9))
    _gather(matches, sample, x1, x2)
    count = fundamental_seven_point(x1, x2, found, work)
    for k in range(count):
        models[k, :9] = found[k]
        models[k, 27] = -1.0  # not decomposed yet
    return count


@kernel(allocates=True)
def _solve_homography(matches, sample, models):
    x1, x2 = np.empty((4, 3)), np.empty((4, 3))
    _gather(matches, sample, x1, x2)
    return 1 if homography_four_point(x1, x2, models[0]) else 0


@kernel(allocates=True)
def _solve_absolute_pose(points, rays, sample, models, work):
    y, x, found = np.empty((3, 3)), np.empty((3, 3)), np.empty((4, 12))
    for k in range(3):
        for c in range(3):
            y[k, c], x[k, c] = rays[sample[k], c], points[c, sample[k]]
    count = p3p(y, x, found, work)
    for k in range(count):
        models[k, :12] = found[k]
    return count


_specialize(
    solve_sample,
    EssentialProblem=lambda problem, sample, models, work: _solve_essential(
        problem.matches, sample, models, work
    ),
    FundamentalProblem=lambda problem, sample, models, work: _solve_fundamental(
        problem.matches, sample, models, work
    ),
    HomographyProblem=lambda problem, sample, models, work: _solve_homography(
        problem.matches, sample, models
    ),
    AbsolutePoseProblem=lambda problem, sample, models, work: _solve_absolute_pose(
        problem.points, problem.rays, sample, models, work
    ),
)


@kernel(allocates=True)
def _score_motion(matches, motion, threshold_sq, bail_out):
    e = np.empty(9)
    essential_from_motion(motion, e)
    return s.sampson_score(e, matches, threshold_sq, bail_out)


_specialize(
    score,
    EssentialProblem=lambda problem, model, bail_out: _score_motion(
        problem.matches, model, problem.threshold_sq, bail_out
    ),
    FundamentalProblem=lambda problem, model, bail_out: s.sampson_score(
        model, problem.matches, problem.threshold_sq, bail_out
    ),
    HomographyProblem=lambda problem, model, bail_out: s.transfer_score(
        model, problem.matches, problem.threshold_sq, bail_out
    ),
    AbsolutePoseProblem=lambda problem, model, bail_out: s.reprojection_score(
        model,
        problem.camera_model,
        problem.camera_params,
        problem.points,
        problem.pixels,
        problem.threshold_sq,
        bail_out,
    ),
)


@kernel(allocates=True)
def _residuals_motion(matches, motion, out):
    e = np.empty(9)
    essential_from_motion(motion, e)
    s.sampson_all(e, matches, out)


_specialize(
    residuals_sq,
    EssentialProblem=lambda problem, model, out: _residuals_motion(problem.matches, model, out),
    FundamentalProblem=lambda problem, model, out: s.sampson_all(model, problem.matches, out),
    HomographyProblem=lambda problem, model, out: s.transfer_all(model, problem.matches, out),
    AbsolutePoseProblem=lambda problem, model, out: s.reprojection_all(
        model, problem.camera_model, problem.camera_params, problem.points, problem.pixels, out
    ),
)


@kernel
def _project_normal_equations(a9, b9, d, a, b):
    """A = D^T A D, b = D^T B for the derivative D (size, 9) of the matrix entries."""
    for i in range(len(d)):
        b[i] = 0.0
        for k in range(9):
            b[i] += d[i, k] * b9[k]
        for j in range(i + 1):
            total = 0.0
            for k in range(9):
                inner = 0.0
                for m in range(9):
                    inner += a9[k, m] * d[j, m]
                total += d[i, k] * inner
            a[i, j] = a[j, i] = total


@kernel
def _tangent_of_direction(t, basis):
    """Two unit vectors (rows of basis) orthogonal to t and to each other."""
    c = 0
    if abs(t[1]) < abs(t[c]):
        c = 1
    if abs(t[2]) < abs(t[c]):
        c = 2
    dot = t[c]
    norm = 0.0
    for i in range(3):
        basis[0, i] = (1.0 if i == c else 0.0) - dot * t[i]
        norm += basis[0, i] ** 2
    norm = 1.0 / math.sqrt(norm)
    for i in range(3):
        basis[0, i] *= norm
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        basis[1, i] = t[j] * basis[0, k] - t[k] * basis[0, j]


@kernel(allocates=True)
def _linearize_motion(matches, motion, threshold_sq, a, b):
    """E = [t]x R: the rotation from the left, t on the unit sphere."""
    e, a9, b9, d = np.empty(9), np.empty((9, 9)), np.empty(9), np.zeros((5, 9))
    moved, basis = np.zeros(12), np.empty((2, 3))
    essential_from_motion(motion, e)
    total = s.sampson_normal_equations(e, matches, threshold_sq, a9, b9)
    moved[9:] = motion[9:12]
    for w in range(3):
        p, q = (w + 1) % 3, (w + 2) % 3
        for j in range(3):  # [e_w]x R
            moved[3 * w + j], moved[3 * p + j], moved[3 * q + j] = 0.0, -motion[3 * q + j], motion[3 * p + j]
        essential_from_motion(moved, d[w])
    _tangent_of_direction(motion[9:12], basis)
    moved[:9] = motion[:9]
    for c in range(2):
        moved[9:] = basis[c]
        essential_from_motion(moved, d[3 + c])
    _project_normal_equations(a9, b9, d, a, b)
    return total


@kernel
def rotate_left(phi, r, out):
    """Out = exp(phi) r for rotations row by row, renormalised to first order by the exact formula."""
    angle = math.sqrt(phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2)
    first = 1.0 - angle * angle / 6.0 if angle < 1e-4 else math.sin(angle) / angle
    second = 0.5 - angle * angle / 24.0 if angle < 1e-4 else (1.0 - math.cos(angle)) / (angle * angle)
    x, y, z = phi[0], phi[1], phi[2]
    for j in range(3):
        a, b, c = r[j], r[3 + j], r[6 + j]
        u, v, w = y * c - z * b, z * a - x * c, x * b - y * a
        out[j] = a + first * u + second * (y * w - z * v)
        out[3 + j] = b + first * v + second * (z * u - x * w)
        out[6 + j] = c + first * w + second * (x * v - y * u)


@kernel(allocates=True)
def _retract_direction(motion, delta, out):
    basis = np.empty((2, 3))
    rotate_left(delta, motion, out)
    _tangent_of_direction(motion[9:12], basis)
    norm = 0.0
    for i in range(3):
        out[9 + i] = motion[9 + i] + delta[3] * basis[0, i] + delta[4] * basis[1, i]
        norm += out[9 + i] ** 2
    norm = 1.0 / math.sqrt(norm)
    for i in range(3):
        out[9 + i] *= norm


@kernel(allocates=True)
def _retract_motion(motion, delta, out):
    """exp(xi) @ motion to first order in the translation: xi = (rho, phi)."""
    rotate_left(delta[3:6], motion, out)
    x, y, z = delta[3], delta[4], delta[5]
    angle = math.sqrt(x * x + y * y + z * z)
    first = 1.0 - angle * angle / 6.0 if angle < 1e-4 else math.sin(angle) / angle
    second = 0.5 - angle * angle / 24.0 if angle < 1e-4 else (1.0 - math.cos(angle)) / (angle * angle)
    a, b, c = motion[9], motion[10], motion[11]
    u, v, w = y * c - z * b, z * a - x * c, x * b - y * a
    out[9] = a + first * u + second * (y * w - z * v) + delta[0]
    out[10] = b + first * v + second * (z * u - x * w) + delta[1]
    out[11] = c + first * w + second * (x * v - y * u) + delta[2]


@kernel(allocates=True)
def _linearize_fundamental(matches, model, threshold_sq, a, b):
    """F = U diag(1, s, 0) V^T with seven parameters (Bartoli and Sturm, PAMI 2004): U exp(u), V exp(v), s + d."""
    if model[27] < 0.0:
        m, u, sv, v = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty((3, 3))
        for i in range(9):
            m[i // 3, i % 3] = model[i]
        if not svd3(m, u, sv, v):
            b[:] = 0.0
            return math.inf
        for i in range(9):
            model[9 + i], model[18 + i] = u[i // 3, i % 3], v[i // 3, i % 3]
        model[27] = sv[1] / sv[0]
        _compose_fundamental(model)
    u, v, ratio = model[9:18], model[18:27], model[27]
    a9, b9, d = np.empty((9, 9)), np.empty(9), np.zeros((7, 9))
    total = s.sampson_normal_equations(model, matches, threshold_sq, a9, b9)
    for i in range(3):
        for j in range(3):
            k = 3 * i + j
            u0, u1, u2 = u[3 * i], u[3 * i + 1], u[3 * i + 2]
            v0, v1, v2 = v[3 * j], v[3 * j + 1], v[3 * j + 2]
            # U [e_w]x S V^T and U S [e_w]x^T V^T, written out for S = diag(1, ratio, 0).
            d[0, k] = u2 * ratio * v1
            d[1, k] = -u2 * v0
            d[2, k] = u1 * v0 - u0 * ratio * v1
            d[3, k] = u1 * ratio * v2
            d[4, k] = -u0 * v2
            d[5, k] = u0 * v1 - u1 * ratio * v0
            d[6, k] = u1 * v1
    _project_normal_equations(a9, b9, d, a, b)
    return total


@kernel
def _compose_fundamental(model):
    for i in range(3):
        for j in range(3):
            model[3 * i + j] = (
                model[9 + 3 * i] * model[18 + 3 * j] + model[27] * model[10 + 3 * i] * model[19 + 3 * j]
            )


@kernel(allocates=True)
def _retract_fundamental(model, delta, out):
    transposed, turned = np.empty(9), np.empty(9)
    for which in range(2):
        base = 9 + 9 * which
        for i in range(3):
            for j in range(3):
                transposed[3 * j + i] = model[base + 3 * i + j]
        # U exp(u) = (exp(-u) U^T)^T
        rotate_left(-delta[3 * which : 3 * which + 3], transposed, turned)
        for i in range(3):
            for j in range(3):
                out[base + 3 * i + j] = turned[3 * j + i]
    out[27] = max(model[27] + delta[6], 0.0)
    _compose_fundamental(out)


@kernel
def _retract_homography(model, delta, out):
    norm = 0.0
    for i in range(9):
        out[i] = model[i] + delta[i]
        norm += out[i] * out[i]
    norm = 1.0 / math.sqrt(norm)
    for i in range(9):
        out[i] *= norm


_specialize(
    linearize,
    EssentialProblem=lambda problem, model, a, b: _linearize_motion(
        problem.matches, model, problem.threshold_sq, a, b
    ),
    FundamentalProblem=lambda problem, model, a, b: _linearize_fundamental(
        problem.matches, model, problem.threshold_sq, a, b
    ),
    HomographyProblem=lambda problem, model, a, b: s.transfer_normal_equations(
        model, problem.matches, problem.threshold_sq, a, b
    ),
    AbsolutePoseProblem=lambda problem, model, a, b: s.reprojection_normal_equations(
        model,
        problem.camera_model,
        problem.camera_params,
        problem.points,
        problem.pixels,
        problem.threshold_sq,
        a,
        b,
    ),
)
_specialize(
    retract,
    EssentialProblem=lambda problem, model, delta, out: _retract_direction(model, delta, out),
    FundamentalProblem=lambda problem, model, delta, out: _retract_fundamental(model, delta, out),
    HomographyProblem=lambda problem, model, delta, out: _retract_homography(model, delta, out),
    AbsolutePoseProblem=lambda problem, model, delta, out: _retract_motion(model, delta, out),
)


@kernel(allocates=True)
def refine(problem, model, max_steps):
    """Levenberg-Marquardt on the truncated loss, from `model`, in place; returns the score reached."""
    size = degrees_of_freedom(problem)
    a, b, damped, step = np.empty((9, 9)), np.empty(9), np.empty((9, 9)), np.empty(9)
    tried = np.empty(MODEL_SIZE)
    damping = 1e-3
    current = linearize(problem, model, a, b)
    for _ in range(max_steps):
        if not current < math.inf:
            break
        for i in range(size):
            step[i] = -b[i]
            for j in range(size):
                damped[i, j] = a[i, j]
            damped[i, i] += damping * a[i, i] + 1e-15
        if not solve_spd(damped, step, size):
            damping *= 10.0
            continue
        retract(problem, model, step, tried)
        after = score(problem, tried, current)
        if after < current:
            gain = current - after
            model[:] = tried
            damping = max(0.1 * damping, 1e-9)
            if gain < 1e-6 * current:
                return after
            current = linearize(problem, model, a, b)
        else:
            damping *= 10.0
            if damping > 1e3:
                break
    return current


@kernel
def _next_random(state):
    """splitmix64 (Steele, Lea, Flood, OOPSLA 2014)."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@kernel
def _draw(state, n, size, sample):
    """`size` different numbers below n."""
    for k in range(size):
        fresh = False
        while not fresh:
            sample[k] = np.int64(_next_random(state) % np.uint64(n))
            fresh = True
            for j in range(k):
                if sample[j] == sample[k]:
                    fresh = False


@kernel
def _count_within(problem, model, residuals):
    residuals_sq(problem, model, residuals)
    count = 0
    for k in range(len(residuals)):
        if residuals[k] < problem.threshold_sq:
            count += 1
    return count


@kernel
def _iterations_needed(ratio, size, confidence, safety, least, most):
    """log(1 - confidence) / log(1 - ratio^size) samples hold one of inliers alone (Fischler and Bolles 1981)."""
    miss = 1.0 - ratio**size
    if miss <= 0.0:
        return least
    if miss >= 1.0:
        return most
    count = safety * math.log(1.0 - confidence) / math.log(miss)
    return int(min(float(most), max(float(least), count)))


@kernel(allocates=True)
def ransac(problem, confidence, min_iterations, max_iterations, min_ratio, seed, best, residuals):
    """Write the best model into `best` (MODEL_SIZE) and its squared residuals into `residuals` (n).

    Returns (score, iterations); the score is infinite if no model was found.
    """
    n, size = num_items(problem), sample_size(problem)
    state = np.empty(1, np.uint64)
    state[0] = np.uint64(seed)
    work, models, local = workspace(problem), np.empty((40, MODEL_SIZE)), np.empty(MODEL_SIZE)
    sample = np.empty(8, np.int64)
    best_score, best_minimal, iteration = math.inf, math.inf, 0
    # A smaller share of inliers than this would count as failure: no need to search for it.
    needed = _iterations_needed(min_ratio, size, confidence, 1.0, min_iterations, max_iterations)
    while iteration < needed:
        iteration += 1
        _draw(state, n, size, sample)
        improved = -1
        for k in range(solve_sample(problem, sample, models, work)):
            this = score(problem, models[k], best_minimal)
            if this < best_minimal:
                best_minimal, improved = this, k
        if improved < 0:
            continue
        local[:] = models[improved]
        this = min(refine(problem, local, np.int64(LOCAL_STEPS)), best_minimal)
        if this < best_score:
            best_score = this
            best[:] = local
            ratio = _count_within(problem, local, residuals) / n
            enough = _iterations_needed(ratio, size, confidence, SAFETY, min_iterations, max_iterations)
            needed = min(needed, enough)
    if best_score < math.inf:
        best_score = refine(problem, best, np.int64(FINAL_STEPS))
        residuals_sq(problem, best, residuals)
    return best_score, iteration
