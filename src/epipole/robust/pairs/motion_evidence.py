"""Maximum-likelihood refinement of a relative pose: sign, uncertainty, and whether the matches determine it.

The robust loop truncates residuals at a threshold that is usually several times the noise. Its motion is the start of a
maximum-likelihood fit. A match is correct with probability p: then its Sampson residual is normal, and its inverse depth rho
has a Student distribution over the scene. A wrong match can lie anywhere in the image,

    L(R, t) = sum_k log( p N(s_k; 0, sigma) T(rho_k) |drho/dx| [rho_k > 0] + (1 - p) / area ),

fitted by expectation maximization (Dempster, Laird and Rubin, 1977). Wrong matches that lie on their epipolar line by chance
mostly have an implausible depth, and lose their weight. Then

- the sign of t is the more likely one: depths must be positive, within the estimated noise;
- there must be parallax: displacements along the epipolar lines, after the best rotation, must exceed the noise;
- the sphere of directions is searched for other motions that explain the matches equally well;
- if the likelihood is not Gaussian, the covariance is that of samples (adaptive importance sampling: Cappe et al.,
  Population Monte Carlo, 2004).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from scipy.special import gammaln

from epipole.geometry import Rotation3, skew
from epipole.robust.ray_matches import Matches, moved_motion

MAX_BEHIND = 10.0
"""Upper bound of the deviation of a match behind the cameras, in standard deviations."""
MAX_STEPS = 30  # of the fit
MAX_MATCHES = 600  # used in the searches after the fit (a random choice)
STUDENT = 3.0
"""Degrees of freedom of the inverse depths: most of a scene within a factor of two, some of it anywhere."""
MIN_SIGN_EVIDENCE = 3.0
"""Difference of log likelihoods below which the sign of t is unknown: odds of twenty to one."""
MAX_PARALLAX_SQ = 9.0
"""Upper bound of the squared parallax of one match, in variances, so that a few wrong matches cannot fake motion."""
MEAN_PARALLAX_SQ = 0.98  # mean of a squared standard normal number, truncated at MAX_PARALLAX_SQ
VAR_PARALLAX_SQ = 1.7  # its variance
SIGNIFICANT = 5.0
"""Standard deviations by which the parallax must exceed chance."""
WELL_DETERMINED = 25.0
"""Ratio of the information of the matches to that of their noise above which the likelihood is Gaussian (measured)."""
MIN_SPREAD_SIGMAS = 3.0
"""Minimum spread of the matches across their best-fitting line, in standard deviations of the noise."""
NUM_DIRECTIONS, SEARCH_STEPS = 48, 12
RIVAL_EVIDENCE = 4.0
"""Difference of log likelihoods within which another motion explains the matches equally well."""
RIVAL_ANGLE_RAD = np.deg2rad(15.0)  # directions closer than this, and than RIVAL_SIGMAS, are the same motion
RIVAL_SIGMAS = 5.0
NUM_SAMPLES, NUM_ROUNDS = 600, 5
STUDENT_CONSTANT = float(
    gammaln((STUDENT + 1.0) / 2.0) - gammaln(STUDENT / 2.0) - 0.5 * np.log(STUDENT * np.pi)
)


class Verdict(Enum):
    """What the matches show about a motion."""

    DETERMINED = 0
    NO_PARALLAX = 1
    ON_A_LINE = 2
    AMBIGUOUS = 3
    UNKNOWN_SIGN = 4


@dataclass(frozen=True, slots=True, eq=False)
class MotionEvidence:
    """A motion estimated at the noise of its matches."""

    rotation: np.ndarray
    translation: np.ndarray
    covariance: np.ndarray
    """(5, 5) of (rotation from the left, step of t in its tangent plane)."""
    residuals_px: np.ndarray
    """(n,) signed Sampson residuals."""
    is_in_front: np.ndarray
    """(n,) whether the depth is positive, or infinite within the noise."""
    noise_px: float
    verdict: Verdict


@dataclass(frozen=True, slots=True)
class _Model:
    """Noise in pixels, fraction of correct matches, and location and scale of the inverse depths."""

    sigma: float
    fraction: float
    location: float
    scale: float


def weigh_motion(
    matches: Matches, rotation: np.ndarray, translation: np.ndarray, noise_px: float, seed: int
) -> MotionEvidence | None:
    """Fit the motion to the matches at their own noise and judge it; None if the fit fails.

    Args:
        matches: all usable matches, right and wrong.
        rotation: initial, (3, 3).
        translation: initial, a unit vector.
        noise_px: initial standard deviation of a pixel coordinate.
        seed: for the choice of matches and the samples.
    """
    random = np.random.default_rng(seed)
    fitted = _fit(matches, rotation, translation, noise_px)
    if fitted is None:
        return None
    rotation, translation, model, weight = fitted
    jacobian = matches.jacobian(rotation, translation)
    information = (jacobian * weight[:, None]).T @ jacobian / model.sigma**2
    if not (np.isfinite(information).all() and np.linalg.eigvalsh(information)[0] > 0):
        return None
    covariance = np.linalg.inv(information)
    few = matches
    if len(matches) > MAX_MATCHES:
        few = matches.chosen(np.sort(random.choice(len(matches), MAX_MATCHES, replace=False)))
    noise = _noise_information(matches, rotation, translation, weight, model.sigma)
    verdict = Verdict.DETERMINED
    sign = _sign_evidence(few, rotation, translation, model)
    if any(lie_on_a_line(pixels, model.sigma, weight) for pixels in (matches.pixels1, matches.pixels2)):
        verdict = Verdict.ON_A_LINE
    elif not _has_parallax(matches, rotation, translation, model, weight):
        verdict = Verdict.NO_PARALLAX
    elif sign < MIN_SIGN_EVIDENCE:
        verdict = Verdict.UNKNOWN_SIGN
    elif _weakest(information, noise) < WELL_DETERMINED:
        scale = np.sqrt(len(matches) / len(few))
        if _has_rival(few, rotation, translation, model, covariance * scale**2):
            verdict = Verdict.AMBIGUOUS
        else:
            step, covariance = _sampled(few, rotation, translation, model, covariance * scale**2, random)
            rotation, translation = moved_motion(step, rotation, translation)
            covariance = covariance / scale**2
        covariance = covariance + covariance @ noise @ covariance  # (H - N)^-1, to first order
    depth_px, _ = matches.parallax(rotation, translation)
    return MotionEvidence(
        rotation,
        translation,
        covariance,
        matches.sampson(rotation, translation),
        depth_px > -3.0 * np.sqrt(2.0) * model.sigma,
        model.sigma,
        verdict,
    )


def lie_on_a_line(pixels: np.ndarray, sigma_px: float, weight: np.ndarray | None = None) -> bool:
    """Whether the spread of pixels (n, 2) across their best-fitting line is within the noise."""
    off = pixels - np.average(pixels, axis=0, weights=weight)
    least = np.linalg.eigvalsh(np.cov(off.T, aweights=weight, ddof=0))[0]
    return bool(least < (1.0 + MIN_SPREAD_SIGMAS**2) * sigma_px**2)


def _fit(
    matches: Matches, rotation: np.ndarray, translation: np.ndarray, noise_px: float
) -> tuple[np.ndarray, np.ndarray, _Model, np.ndarray] | None:
    """Expectation maximization: (R, t, model, (n,) probability that a match is correct)."""
    near = np.abs(matches.sampson(rotation, translation)) < 3.0 * noise_px
    if near.sum() < 6:
        return None
    start = _Model(
        noise_px,
        min(max(0.1, float(near.mean())), 0.995),
        *_depths(matches, rotation, translation, near, noise_px),
    )
    if _sign_evidence(matches, rotation, translation, start) < 0:
        translation = -translation
        start = replace(start, location=-start.location)
    model = start
    for _ in range(MAX_STEPS):
        weight = _weights(matches, rotation, translation, model)
        if weight.sum() < 6:
            return None
        residual = matches.sampson(rotation, translation)
        jacobian = matches.jacobian(rotation, translation)
        weighted = jacobian * weight[:, None]
        normal = weighted.T @ jacobian
        normal += 1e-12 * np.trace(normal) * np.eye(5)
        step = -np.linalg.solve(normal, weighted.T @ residual)
        if not np.isfinite(step).all():
            return None
        rotation, translation = moved_motion(step, rotation, translation)
        residual = matches.sampson(rotation, translation)
        sigma = float(np.sqrt((weight * residual**2).sum() / max(weight.sum() - 5.0, 1.0)))
        sigma = max(sigma, 1e-3 * noise_px, 1e-6)
        depths = _depths(matches, rotation, translation, weight > 0.5, sigma)
        model = _Model(sigma, float(np.clip(weight.mean(), 0.02, 0.995)), *depths)
        if float(step @ normal @ step) < (1e-2 * sigma) ** 2:
            break
    weight = _weights(matches, rotation, translation, model)
    return rotation, translation, model, weight


def _depths(
    matches: Matches, rotation: np.ndarray, translation: np.ndarray, rows: np.ndarray, sigma: float
) -> tuple[float, float]:
    """Median and scale of the inverse depths of some matches."""
    shift, speed = matches.parallax(rotation, translation)
    inverse = (shift / speed)[rows]
    if not len(inverse):
        return 0.0, 1.0
    location = float(np.median(inverse))
    scale = 1.4826 * float(np.median(np.abs(inverse - location)))
    return location, max(scale, 0.1 * sigma / float(np.median(speed)))


def _right(matches: Matches, rotation: np.ndarray, translation: np.ndarray, model: _Model) -> np.ndarray:
    """(n,) log density of a correct match: of its residual, the sign of its depth, and its inverse depth."""
    residual, behind = _residuals(matches, rotation, translation, model)
    depth = _log_depth(matches, rotation, translation, model)
    return np.log(model.fraction) - 0.5 * (residual**2 + behind**2) + depth


def _residuals(
    matches: Matches, rotation: np.ndarray, translation: np.ndarray, model: _Model
) -> tuple[np.ndarray, np.ndarray]:
    """(..., n) Sampson residuals and displacements behind infinity, in standard deviations of the noise."""
    shift, _ = matches.parallax(rotation, translation)
    behind = np.clip(-shift / (np.sqrt(2.0) * model.sigma), 0.0, MAX_BEHIND)
    return matches.sampson(rotation, translation) / model.sigma, behind


def _log_depth(matches: Matches, rotation: np.ndarray, translation: np.ndarray, model: _Model) -> np.ndarray:
    """(n,) log density of a correct match's inverse depth, per square pixel at zero residual."""
    shift, speed = matches.parallax(rotation, translation)
    spread = np.sqrt(model.scale**2 + 2.0 * (model.sigma / speed) ** 2)
    off = (shift / speed - model.location) / spread
    student = STUDENT_CONSTANT - 0.5 * (STUDENT + 1.0) * np.log1p(off**2 / STUDENT)
    return student - np.log(spread * speed) - np.log(np.sqrt(2.0 * np.pi) * model.sigma)


def _weights(matches: Matches, rotation: np.ndarray, translation: np.ndarray, model: _Model) -> np.ndarray:
    """(n,) probability that a match is correct."""
    right = _right(matches, rotation, translation, model)
    return np.exp(right - np.logaddexp(right, np.log1p(-model.fraction) - matches.log_area))


def _likelihood(
    matches: Matches, rotation: np.ndarray, translation: np.ndarray, model: _Model, depth: np.ndarray
) -> np.ndarray:
    """(...) log likelihood of motions near the fitted one; the log density of depths, `depth` (n,), is kept constant."""
    residual, behind = _residuals(matches, rotation, translation, model)
    right = np.log(model.fraction) - 0.5 * (residual**2 + behind**2) + depth
    return np.asarray(np.logaddexp(right, np.log1p(-model.fraction) - matches.log_area).sum(axis=-1))


def _sign_evidence(matches: Matches, rotation: np.ndarray, translation: np.ndarray, model: _Model) -> float:
    """Log likelihood of t minus that of -t; the inverse depths change sign with it."""
    depth = _log_depth(matches, rotation, translation, model)
    here, there = (_likelihood(matches, rotation, t, model, depth) for t in (translation, -translation))
    return float(here - there)


def _has_parallax(
    matches: Matches, rotation: np.ndarray, translation: np.ndarray, model: _Model, weight: np.ndarray
) -> bool:
    """Whether displacements along the epipolar lines, after the best rotation, exceed the noise."""
    for _ in range(5):
        far = matches.ray1 @ rotation.T
        shift = np.einsum("ncj,nj->nc", matches.jacobian2, matches.ray2 - far)
        by_rotation = np.einsum("ncj,njk->nck", matches.jacobian2, skew(far))  # d shift / d phi = J [far]x
        squared = (shift**2).sum(axis=1) / (2.0 * model.sigma**2)
        kept = (weight / (1.0 + squared / MAX_PARALLAX_SQ))[:, None, None] * by_rotation
        normal = np.einsum("ncj,nck->jk", kept, by_rotation) + 1e-12 * np.eye(3)
        step = -np.linalg.solve(normal, np.einsum("ncj,nc->j", kept, shift))
        rotation = Rotation3.exp(step).matrix @ rotation
    along, _ = matches.parallax(rotation, translation)
    squared = np.minimum(along**2 / (2.0 * model.sigma**2), MAX_PARALLAX_SQ)
    count = float(weight.sum())
    doubtful = MAX_PARALLAX_SQ * float((weight * (1.0 - weight)).sum() + 0.02 * (len(weight) - count))
    limit = MEAN_PARALLAX_SQ * count + SIGNIFICANT * np.sqrt(VAR_PARALLAX_SQ * count) + doubtful
    return bool((weight * squared).sum() > limit)


def _noise_information(
    matches: Matches, rotation: np.ndarray, translation: np.ndarray, weight: np.ndarray, sigma: float
) -> np.ndarray:
    """The part of J^T J that is due to pixel noise.

    The rows of J depend on noisy pixels, so that J^T J is full even where the true one is singular:
    E[J^T J] = J0^T J0 + sum E[dJ^T dJ] (Kanatani, Statistical Optimization for Geometric Computation, 1996).
    """
    noise, step = np.zeros((5, 5)), 0.5 * sigma
    for image in (1, 2):
        for axis in (0, 1):
            up, down = (
                matches.moved(image, axis, sign * step).jacobian(rotation, translation) for sign in (1, -1)
            )
            change = (up - down) * (sigma / (2.0 * step))
            noise += (change * weight[:, None]).T @ change / sigma**2
    return noise


def _weakest(information: np.ndarray, noise: np.ndarray) -> float:
    """Smallest ratio, over all directions, of the information to that of the noise."""
    root = np.linalg.cholesky(information)
    fraction = np.linalg.solve(root, np.linalg.solve(root, noise).T)
    return float(1.0 / max(np.linalg.eigvalsh(fraction)[-1], 1e-300))


def _has_rival(
    matches: Matches, rotation: np.ndarray, translation: np.ndarray, model: _Model, covariance: np.ndarray
) -> bool:
    """Whether a motion in another direction explains the matches equally well, searching the full sphere."""
    index = np.arange(NUM_DIRECTIONS) + 0.5
    # Fibonacci sphere
    height, azimuth = 1.0 - 2.0 * index / NUM_DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * index
    flat = np.sqrt(1.0 - height**2)
    t = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height], axis=1)
    r = np.broadcast_to(rotation, (NUM_DIRECTIONS, 3, 3))
    weight = _weights(matches, rotation, translation, model)
    for _ in range(SEARCH_STEPS):
        residual = matches.sampson(r, t)
        soft = weight / (1.0 + (residual / (3.0 * model.sigma)) ** 2)
        jacobian = matches.jacobian(r, t)
        weighted = jacobian * soft[..., None]
        normal = np.swapaxes(weighted, 1, 2) @ jacobian
        normal = normal + (1e-6 * np.trace(normal, axis1=1, axis2=2) / 5.0)[:, None, None] * np.eye(5)
        step = -np.linalg.solve(normal, np.einsum("bnp,bn->bp", weighted, residual)[..., None])[..., 0]
        r, t = moved_motion(np.clip(step, -0.3, 0.3), r, t)
    depth = _log_depth(matches, rotation, translation, model)
    best = float(_likelihood(matches, rotation, translation, model, depth))
    found = np.maximum(*(_likelihood(matches, r, sign * t, model, depth) for sign in (1.0, -1.0)))
    sigma_rad = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
    angle = np.arccos(np.clip(np.abs(t @ translation), 0.0, 1.0))
    is_elsewhere = angle > max(RIVAL_ANGLE_RAD, RIVAL_SIGMAS * sigma_rad)
    return bool((is_elsewhere & (found > best - RIVAL_EVIDENCE)).any())


def _sampled(
    matches: Matches,
    rotation: np.ndarray,
    translation: np.ndarray,
    model: _Model,
    covariance: np.ndarray,
    random: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean step from the fitted motion, and covariance of the likelihood, by importance sampling with Student proposals."""
    spread, mean, moment = 2.0 * covariance, np.zeros(5), covariance
    depth = _log_depth(matches, rotation, translation, model)
    for _ in range(NUM_ROUNDS):
        normal = random.normal(size=(NUM_SAMPLES, 5))
        chi = random.chisquare(STUDENT, NUM_SAMPLES) / STUDENT
        sample = mean + (normal / np.sqrt(chi)[:, None]) @ np.linalg.cholesky(spread).T
        proposed = -0.5 * (STUDENT + 5.0) * np.log1p((normal**2).sum(axis=1) / chi / STUDENT)
        log_weight = (
            _likelihood(matches, *moved_motion(sample, rotation, translation), model, depth) - proposed
        )
        weight = np.exp(log_weight - log_weight.max())
        weight /= weight.sum()
        mean = weight @ sample
        moment = (weight[:, None] * (sample - mean)).T @ (sample - mean)
        spread = 1.3 * moment + 0.1 * covariance
    return mean, moment + 1e-3 * covariance
