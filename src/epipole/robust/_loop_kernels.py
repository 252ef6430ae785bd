"""The robust loop: sample hypotheses, test, score and optimize locally, for any problem.

Samples are uniform, or PROSAC's (Chum and Matas, CVPR 2005) if items are ranked. A model must first pass Wald's
sequential test on a few items (Matas and Chum, ICCV 2005); survivors get an MSAC score (Torr and Zisserman, CVIU 2000).
Good ones are optimized on the truncated loss (Chum, Matas, Kittler, DAGM 2003; Lebeda, Matas, Chum, BMVC 2012), from a
wide threshold to the requested one.
"""

import math

import numpy as np

from epipole._jit import kernel
from epipole.robust._item_kernels import median
from epipole.robust._problem_kernels import MODEL_SIZE, MOST_FREEDOM, MOST_MODELS
from epipole.solvers._linear_kernels import copy_numbers, solve_spd

# Integers are passed as np.int64: Numba compiles a function again for every literal one.
WIDE_STEPS, LOCAL_STEPS, FINAL_STEPS = 4, 8, 30
WIDE = 2.0  # threshold factor at the start of local optimization
NEAR = 3.0  # items beyond this many thresholds are ignored in it
PROMISING = 0.8  # fraction of the best sample's gain above which a model is also optimized locally
MOST_OTHERS = 10  # number of such additional optimizations
TEST_BLOCK, MOST_TESTED = 32, 512
SOFT, REACH = (
    3.0,
    1.5,
)  # Cauchy scale in standard deviations of the noise; largest residual in polishing, in thresholds
POLISH_STEPS = 10
ROUNDING = 1e-9  # of the worst score: smaller gains are rounding errors
BEYOND = 3.64  # reach of polishing an approximate model, in thresholds: 99 % of two Gaussian numbers (MAGSAC)
BROAD_SLACK = 1.3  # allowed score increase if polishing reaches beyond the scored items
POLISH_SLACK = (
    1.1  # allowed score increase: polishing minimizes another cost, but larger increases are failures
)
LOG_REJECT = 7.0  # a good model is rejected with a probability of about exp(-7)


@kernel(allocates=True)
def refine(problem, model, threshold_sq, max_steps):
    """Levenberg-Marquardt on the truncated loss, starting from `model`, in place; returns the final score."""
    size = problem.degrees_of_freedom()
    a, b = np.empty((MOST_FREEDOM, MOST_FREEDOM)), np.empty(MOST_FREEDOM)
    damped, step = np.empty((MOST_FREEDOM, MOST_FREEDOM)), np.empty(MOST_FREEDOM)
    tried = np.empty(MODEL_SIZE)
    damping = 1e-6
    current = problem.linearize(model, threshold_sq, math.inf, a, b)
    for _ in range(max_steps):
        if not current < math.inf:
            break
        for i in range(size):
            step[i] = -b[i]
            for j in range(size):
                damped[i, j] = a[i, j]
            damped[i, i] += damping * a[i, i] + 1e-15
        if not solve_spd(damped, step, size):
            damping = max(100.0 * damping, 1e-4)
            continue
        copy_numbers(model, tried)
        problem.retract(model, step, tried)
        after = problem.score(tried, threshold_sq, current)
        if after < current:
            gain = current - after
            copy_numbers(tried, model)
            damping = max(0.1 * damping, 1e-9)
            if gain < 1e-4 * threshold_sq:
                return after
            current = problem.linearize(model, threshold_sq, math.inf, a, b)
        else:
            damping = max(100.0 * damping, 1e-4)
            if damping > 1e3:
                break
    return current


@kernel(allocates=True)
def noise_variance(residuals, threshold_sq, size):
    """Variance of one coordinate of the noise, from the median residual of the inliers (Rousseeuw and Leroy 1987).

    The median of r^2 is 0.455 variances for residuals of dimension one, 1.386 for two, 2.366 for three.
    """
    inliers, count = np.empty(len(residuals)), 0
    for k in range(len(residuals)):
        if residuals[k] < threshold_sq:
            inliers[count] = residuals[k]
            count += 1
    of_one = 0.455 if size == 1 else (1.386 if size == 2 else 2.366)
    return median(inliers, count) / of_one if count > 0 else threshold_sq


@kernel(allocates=True)
def polish(problem, model, threshold_sq, residuals):
    """Iteratively reweighted least squares at the scale of the noise, in place; returns the score.

    Truncation at the threshold weights all inliers equally, and drops good items if the noise is wide (at two standard
    deviations this costs a tenth of the accuracy). Here items count up to three standard deviations of the noise, with
    Cauchy weights, which hardly change Gaussian noise but suppress heavy tails.
    """
    size, breadth = problem.degrees_of_freedom(), problem.breadth()
    a, b = np.empty((MOST_FREEDOM, MOST_FREEDOM)), np.empty(MOST_FREEDOM)
    tried, before = np.empty(MODEL_SIZE), np.empty(MODEL_SIZE)
    copy_numbers(model, before)
    score_before = problem.score(model, threshold_sq, math.inf)
    noise_sq = max(noise_variance(residuals, threshold_sq, problem.residual_size()), 1e-6 * threshold_sq)
    reach_sq = min(max(9.0 * noise_sq, threshold_sq), REACH * REACH * threshold_sq)
    if breadth > 1.0:  # the threshold is the largest possible deviation
        noise_sq = threshold_sq / (breadth * breadth)
        reach_sq = BEYOND * BEYOND * noise_sq
    for _ in range(POLISH_STEPS):
        problem.linearize(model, reach_sq, SOFT * SOFT * noise_sq, a, b)
        length = 0.0
        for i in range(size):
            length += b[i] * b[i] / (a[i, i] + 1e-300)
            b[i] = -b[i]
            a[i, i] += 1e-9 * a[i, i] + 1e-15
        if not solve_spd(a, b, size):
            break
        copy_numbers(model, tried)
        problem.retract(model, b, tried)
        copy_numbers(tried, model)
        if length < 1e-8 * noise_sq:
            break
    after = problem.score(model, threshold_sq, math.inf)
    if not after < (POLISH_SLACK if breadth <= 1.0 else BROAD_SLACK) * score_before:
        copy_numbers(before, model)
        return score_before
    return after


@kernel(allocates=True)
def optimize_locally(problem, model, threshold_sq):
    """Refine on the items near the model, first with a wide threshold, then with the requested one; returns the score."""
    items = problem.near(model, NEAR * NEAR * threshold_sq)
    refine(items, model, WIDE * WIDE * threshold_sq, np.int64(WIDE_STEPS))
    refine(items, model, threshold_sq, np.int64(LOCAL_STEPS))
    return problem.score(model, threshold_sq, math.inf)


@kernel
def next_random(state):
    """splitmix64 (Steele, Lea, Flood, OOPSLA 2014)."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@kernel
def sample_items(state, n, size, sample):
    """Sample `size` different numbers below n."""
    for k in range(size):
        fresh = False
        while not fresh:
            sample[k] = np.int64(next_random(state) % np.uint64(n))
            fresh = True
            for j in range(k):
                if sample[j] == sample[k]:
                    fresh = False


@kernel
def _passes(problem, model, threshold_sq, fraction, test):
    """Wald's test of an inlier ratio of `fraction` against the chance agreement seen so far.

    test = (agreements, items) of the models rejected so far.
    """
    chance = (test[0] + 1.0) / (test[1] + 50.0)
    if chance >= 0.8 * fraction:
        return True
    for_in, for_out = math.log(chance / fraction), math.log((1.0 - chance) / (1.0 - fraction))
    evidence, agreed, stop = 0.0, 0, min(problem.num_items(), MOST_TESTED)
    for start in range(0, stop, TEST_BLOCK):
        end = min(start + TEST_BLOCK, stop)
        count = problem.agreeing(model, threshold_sq, start, end)
        agreed += count
        evidence += count * for_in + (end - start - count) * for_out
        if evidence > LOG_REJECT:
            test[0] += agreed
            test[1] += end
            return False
    return True


@kernel
def _fraction_within(problem, model, threshold_sq, residuals):
    problem.residuals_sq(model, threshold_sq, residuals)
    count = 0
    for k in range(len(residuals)):
        if residuals[k] < threshold_sq:
            count += 1
    return count / len(residuals)


@kernel
def _iterations_needed(fraction, size, confidence, least, most):
    """Samples needed until one is all inliers: log(1 - confidence) / log(1 - ratio^size) (Fischler and Bolles 1981)."""
    miss = 1.0 - fraction**size
    if miss <= 0.0:
        return least
    if miss >= 1.0:
        return most
    count = math.log(1.0 - confidence) / math.log(miss)
    return int(min(float(most), max(float(least), count)))


@kernel
def _iterations_needed_ranked(ranking, residuals, threshold_sq, size, confidence, least, most):
    """The fewest samples required by any number of the best items (PROSAC's maximality, section 2.2).

    Among the n best, there must be more inliers than a wrong model gets by chance (5 % of the items, plus three sigma).
    """
    fewest, inliers = most, 0
    for n in range(len(ranking)):
        if residuals[ranking[n]] < threshold_sq:
            inliers += 1
        count = n + 1.0
        if inliers > size + 0.05 * count + 3.0 * math.sqrt(0.05 * count):
            fewest = min(fewest, _iterations_needed(inliers / count, size, confidence, least, most))
    return fewest


@kernel
def _sample_ranked(state, ranking, progress, iteration, size, sample):
    """PROSAC's sample: from a set of the best items that grows to all items (Chum and Matas 2005, section 2.1).

    progress = (size of the set, T_n, T'_n).
    """
    n = len(ranking)
    while iteration > progress[2] and progress[0] < n:
        after = progress[1] * (progress[0] + 1.0) / (progress[0] + 1.0 - size)
        progress[2] += math.ceil(after - progress[1])
        progress[1] = after
        progress[0] += 1.0
    best = int(progress[0])
    if iteration <= progress[2] and best > size:
        sample_items(state, best - 1, size - 1, sample)
        sample[size - 1] = best - 1
    else:
        sample_items(state, best, size, sample)
    for k in range(size):
        sample[k] = ranking[sample[k]]


@kernel(allocates=True)
def _start_of_ranked(n, size):
    """(m, T_m, T'_m) for T_N = 200,000 samples over all items."""
    progress = np.array([float(size), 200000.0, 1.0])
    for i in range(size):
        progress[1] *= (size - i) / (n - i)
    return progress


@kernel(allocates=True)
def ransac(
    problem,
    required_sq,
    confidence,
    min_iterations,
    max_iterations,
    min_fraction,
    seed,
    ranking,
    best,
    residuals,
    information,
):
    """Write the best model, the squared residuals (n) and J^T J of its inliers (MOST_FREEDOM, MOST_FREEDOM).

    Samples are uniform, or PROSAC's if `ranking` holds the items, best first (with None, PROSAC is not even compiled).
    Approximate models (real planes are never exactly plane) are searched at their breadth times the threshold and polished
    far beyond it: there the threshold acts as MAGSAC's largest noise level (Barath et al., CVPR 2020). Returns (score,
    iterations); the score is infinite if no model was found.
    """
    breadth = problem.breadth()
    threshold_sq = breadth * breadth * required_sq
    n, size = problem.num_items(), problem.sample_size()
    state, sample = np.empty(1, np.uint64), np.empty(16, np.int64)
    state[0] = seed
    work, test = problem.workspace(), np.zeros(2)
    if ranking is not None:
        progress = _start_of_ranked(n, size)
    models, refined = np.empty((MOST_MODELS, MODEL_SIZE)), np.empty((4, MODEL_SIZE))
    worst = n * threshold_sq
    best_score, best_gain, fraction, iteration, num_others = math.inf, ROUNDING * worst, 0.0, 0, 0
    # An inlier ratio below this counts as failure, so there is no need to search for it.
    needed = _iterations_needed(min_fraction, size, confidence, min_iterations, max_iterations)
    while iteration < needed:
        iteration += 1
        if ranking is not None:
            _sample_ranked(state, ranking, progress, iteration, size, sample)
        else:
            sample_items(state, n, size, sample)
        for k in range(problem.solve_sample(sample, models, work)):
            if fraction > 0.0 and not _passes(problem, models[k], threshold_sq, fraction, test):
                continue
            for c in range(problem.refine(sample, models[k], refined, work)):
                model = refined[c]
                gain = worst - problem.score(model, threshold_sq, worst - PROMISING * best_gain)
                if gain <= PROMISING * best_gain or (gain <= best_gain and num_others == MOST_OTHERS):
                    continue
                num_others += 1 if gain <= best_gain else 0
                best_gain = max(best_gain, gain)
                this = optimize_locally(problem, model, threshold_sq)
                if this < best_score:
                    best_score = this
                    copy_numbers(model, best)
                    fraction = _fraction_within(problem, model, threshold_sq, residuals)
                    enough = _iterations_needed(fraction, size, confidence, min_iterations, max_iterations)
                    if ranking is not None:
                        ranked = _iterations_needed_ranked(
                            ranking, residuals, threshold_sq, size, confidence, min_iterations, max_iterations
                        )
                        enough = min(enough, ranked)
                    needed = min(needed, enough)
    if best_score < math.inf:
        problem.escape(best, residuals, threshold_sq, state)
        refine(problem, best, threshold_sq, np.int64(FINAL_STEPS))
        problem.residuals_sq(best, threshold_sq, residuals)
        best_score = polish(problem, best, threshold_sq, residuals)
        if breadth > 1.0:
            best_score = problem.score(best, required_sq, math.inf)
        problem.residuals_sq(best, required_sq, residuals)
        problem.linearize(best, required_sq, math.inf, information, np.empty(MOST_FREEDOM))
    return best_score, iteration
