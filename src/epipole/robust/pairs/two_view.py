"""Robust two-view estimators: homography, fundamental and essential matrix, relative pose."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.special import bdtrc

from epipole._checks import as_points, checked, require_same_length
from epipole.cameras import Camera
from epipole.config import RansacConfig, options_of
from epipole.geometry import Rigid3, essential_from_cam2_from_cam1
from epipole.robust.absolute_pose import rotate_upright
from epipole.robust.estimate import (
    Estimate,
    Found,
    Reason,
    checked_quality,
    random_order,
    run_loop,
    usable_rows,
)
from epipole.robust.pairs import _pair_kernels as kernels
from epipole.robust.pairs._fundamental_kernels import (
    FundamentalProblem,
    derivatives_of_fundamental,
    parallax_support,
)
from epipole.robust.pairs._homography_kernels import HomographyProblem
from epipole.robust.pairs._relative_pose_kernels import RelativePoseProblem, tangent_of_direction
from epipole.robust.pairs._upright_motion_kernels import UprightMotionProblem
from epipole.robust.pairs.batch import (
    fit_motions,
    found_of_one,
    no_fits,
    pack_pairs,
    search_for,
    to_coordinates,
    usable_matches,
)
from epipole.robust.pairs.motion_evidence import Verdict, lie_on_a_line, weigh_motion
from epipole.robust.ray_matches import Matches
from epipole.robust.rays import rays_on_plane

Matrix3 = Float64[np.ndarray, "3 3"]


@checked
def estimate_relative_pose(
    pixels1: Any,
    pixels2: Any,
    camera1: Camera,
    camera2: Camera,
    config: RansacConfig | None = None,
    *,
    quality: Any = None,
) -> Estimate[Rigid3]:
    """Relative pose of two calibrated cameras: five points (Nister, PAMI 2004), truncated Sampson error, maximum likelihood.

    The motion of the robust loop is refined at the noise of the matches (`motion_evidence`), which also determines the sign of
    t. If a rotation, a line or another motion explains the matches equally well, the result is `Reason.DEGENERATE`; if all
    points are too far away for the sign of t, `Reason.UNKNOWN_SIGN`.

    Args:
        pixels1: matches in image 1, (n, 2); rows with NaN or infinity are outliers.
        pixels2: the same in image 2.
        camera1: any model. For wide-angle cameras the error is that in the images (tangent Sampson: Terekhov and Larsson,
            ICCV 2023), including rays beyond 90 degrees.
        camera2: any model.
        config: `max_error_px` is divided by the mean focal length.
        quality: (n,), higher is better; good matches are then sampled first (PROSAC).

    Returns:
        `model` = cam2_from_cam1 with |t| = 1 (the scale is unknown); `covariance` (6, 6) of xi in exp(xi) @ cam2_from_cam1,
        xi = (translation, rotation), of rank five. It accounts for wrong matches, but not for calibration errors.

    Raises:
        ShapeError: array sizes do not match.
    """
    options = options_of(RansacConfig, config)
    found = _fit_motion(pixels1, pixels2, camera1, camera2, options, quality)
    found = _at_its_noise(found, pixels1, pixels2, (camera1, camera2), options)
    motion = Rigid3(found.raw[:9].reshape(3, 3).copy(), found.raw[9:12].copy())
    return found.estimate(motion, _twist_covariance(found))


@checked
def estimate_upright_motion(
    pixels1: Any,
    pixels2: Any,
    camera1: Camera,
    camera2: Camera,
    down_in_cams: tuple[Any, Any],
    config: RansacConfig | None = None,
) -> Estimate[Rigid3]:
    """Relative pose of two calibrated cameras with known verticals: three points, then as `estimate_relative_pose`.

    The verticals (from an accelerometer) are used for sampling only, which needs far fewer samples; the refined motion is free of
    them, so an error of a degree costs no accuracy.

    Args:
        pixels1: matches in image 1, (n, 2).
        pixels2: the same in image 2.
        camera1: any model.
        camera2: any model.
        down_in_cams: gravity in the coordinates of camera 1 and of camera 2, (3,) each.
        config: `max_error_px` is divided by the mean focal length.

    Returns:
        As `estimate_relative_pose`.

    Raises:
        ShapeError: array sizes do not match, or a direction is zero.
    """
    up1, up2 = (rotate_upright(down, f"down_in_cams[{k}]") for k, down in enumerate(down_in_cams))
    cameras, options = (camera1, camera2), options_of(RansacConfig, config)
    found = _fit_upright_motion(pixels1, pixels2, cameras, (up1, up2), options)
    motion = Rigid3(found.raw[:9].reshape(3, 3).copy(), found.raw[9:12].copy())
    return found.estimate(motion, _twist_covariance(found))


@checked
def estimate_essential_matrix(
    pixels1: Any,
    pixels2: Any,
    camera1: Camera,
    camera2: Camera,
    config: RansacConfig | None = None,
    *,
    quality: Any = None,
) -> Estimate[Matrix3]:
    """Essential matrix of two calibrated cameras, y2^T E y1 = 0, |E| = 1: that of `estimate_relative_pose`.

    Args:
        pixels1: matches in image 1, (n, 2).
        pixels2: the same in image 2.
        camera1: any model.
        camera2: any model.
        config: `max_error_px` is divided by the mean focal length.
        quality: (n,), higher is better (PROSAC).

    Returns:
        `model` = E; `covariance` (6, 6) as for the relative pose.

    Raises:
        ShapeError: array sizes do not match.
    """
    found = estimate_relative_pose(pixels1, pixels2, camera1, camera2, config, quality=quality)
    essential = essential_from_cam2_from_cam1(found.model) / np.sqrt(2.0)  # |[t]x R| = sqrt(2) |t|
    return Estimate(
        essential,
        found.reason,
        found.inlier_mask,
        found.residuals_px,
        found.num_iterations,
        found.score,
        found.noise_px,
        found.covariance,
    )


MIN_MATCHES_TO_WEIGH = 12
"""Minimum number of matches to estimate their noise."""
REASON_OF_VERDICT = {
    Verdict.DETERMINED: Reason.OK,
    Verdict.NO_PARALLAX: Reason.DEGENERATE,
    Verdict.ON_A_LINE: Reason.DEGENERATE,
    Verdict.AMBIGUOUS: Reason.DEGENERATE,
    Verdict.UNKNOWN_SIGN: Reason.UNKNOWN_SIGN,
}
_NO_ITEMS = np.empty((4, 0))
_ALL_BUT_CHANCE = 0.8
"""Fraction of inliers on one plane above which agreement off the plane is tested against chance."""


def estimate_fundamental_matrix(
    pixels1: Any, pixels2: Any, config: RansacConfig | None = None, *, quality: Any = None
) -> Estimate[Matrix3]:
    """Fundamental matrix, x2^T F x1 = 0, |F| = 1: seven points, then truncated Sampson error.

    Matches must satisfy the oriented epipolar constraint (Chum, Werner and Matas, ICPR 2004). If a plane contains most matches,
    those off it decide (Chum, Werner and Matas, CVPR 2005); if no more of them agree than by chance, F is undetermined:
    `Reason.DEGENERATE`.

    Args:
        pixels1: matches in image 1, (n, 2); rows with NaN or infinity are outliers.
        pixels2: the same in image 2.
        config: threshold in pixels.
        quality: (n,), higher is better (PROSAC).

    Returns:
        `model` = F; `covariance` (9, 9) of its entries, row by row, of rank seven.

    Raises:
        ShapeError: array sizes do not match.
    """
    config = options_of(RansacConfig, config)
    one = _one_pair(pixels1, pixels2, None, config, quality)
    kernels.fit_fundamentals(one.pairs, np.ones(1, bool), one.use, one.quality, search_for(config), one.fits)
    found = _off_a_line(found_of_one(FundamentalProblem(_NO_ITEMS), one.use, one.fits, config), one)
    t1, t2 = to_coordinates(one.fits, 0)
    if found.reason is Reason.OK and _is_explained_by_a_plane(one, config):
        found = replace(found, reason=Reason.DEGENERATE, covariance=np.full((7, 7), np.inf))
    model = t2.T @ found.raw[:9].reshape(3, 3) @ t1
    norm = np.linalg.norm(model)
    entries = np.kron(t2.T, t1.T) / norm  # vec(T2^T F T1), row by row
    return found.estimate(
        model / norm, _projected(entries @ _entries_of_fundamental(found.raw), model, found)
    )


def estimate_homography(
    pixels1: Any, pixels2: Any, config: RansacConfig | None = None, *, quality: Any = None
) -> Estimate[Matrix3]:
    """Homography, x2 ~ H x1, |H| = 1: four points, then a truncated symmetric transfer error.

    Real planes are not exactly plane, and deviations exceed any pixel threshold: models are searched at 1.5 times the threshold,
    and the best is fitted to all matches within 3.64 times the threshold, with more weight on closer ones.

    Args:
        pixels1: matches in image 1, (n, 2); rows with NaN or infinity are outliers.
        pixels2: the same in image 2.
        config: threshold in pixels.
        quality: (n,), higher is better (PROSAC).

    Returns:
        `model` = H; `covariance` (9, 9) of its entries, row by row, of rank eight.

    Raises:
        ShapeError: array sizes do not match.
    """
    config = options_of(RansacConfig, config)
    one = _one_pair(pixels1, pixels2, None, config, quality)
    kernels.fit_homographies(one.pairs, one.use, one.quality, search_for(config), one.fits)
    found = _off_a_line(found_of_one(HomographyProblem(_NO_ITEMS), one.use, one.fits, config), one)
    t1, t2 = to_coordinates(one.fits, 0)
    back = np.linalg.inv(t2)
    model = back @ found.raw[:9].reshape(3, 3) @ t1
    norm = np.linalg.norm(model)
    return found.estimate(model / norm, _projected(np.kron(back, t1.T) / norm, model, found))


class _OnePair(NamedTuple):
    """A list of one pair, its usable matches, their quality, and space for the result."""

    pairs: kernels.Pairs
    use: np.ndarray
    quality: np.ndarray | None
    fits: kernels.Fits


def _one_pair(
    pixels1: Any, pixels2: Any, cameras: tuple[Camera, Camera] | None, config: RansacConfig, quality: Any
) -> _OnePair:
    pairs = pack_pairs([(pixels1, pixels2)], None if cameras is None else [cameras], [config.seed])
    use = usable_matches(pairs)
    return _OnePair(pairs, use, checked_quality(quality, len(use)), no_fits(pairs))


def _fit_motion(
    pixels1: Any,
    pixels2: Any,
    camera1: Camera,
    camera2: Camera,
    config: RansacConfig,
    quality: Any,
) -> Found:
    one = _one_pair(pixels1, pixels2, (camera1, camera2), config, quality)
    fit_motions(one.pairs, np.ones(1, bool), one.use, one.quality, search_for(config), one.fits)
    return found_of_one(RelativePoseProblem(_NO_ITEMS), one.use, one.fits, config)


def _at_its_noise(
    found: Found, pixels1: Any, pixels2: Any, cameras: tuple[Camera, Camera], config: RansacConfig
) -> Found:
    """The maximum-likelihood motion, or the reason why the matches do not determine one."""
    first, second = as_points(pixels1, "pixels1", 2), as_points(pixels2, "pixels2", 2)
    use = np.flatnonzero(usable_rows(first, second))
    if found.reason is not Reason.OK or len(use) < MIN_MATCHES_TO_WEIGH:
        return found
    matches = Matches(first[use], second[use], *cameras)
    has_rays = matches.are_finite()
    use, matches = use[has_rays], matches.chosen(np.flatnonzero(has_rays))
    start = float(np.clip(found.noise, 1e-3 * config.max_error_px, 0.5 * config.max_error_px))
    fitted = weigh_motion(matches, found.raw[:9].reshape(3, 3), found.raw[9:12], start, config.seed)
    undetermined = np.full((5, 5), np.inf)
    if fitted is None:
        return replace(found, reason=Reason.DEGENERATE, covariance=undetermined)
    residuals = np.full(len(first), np.inf)
    residuals[use] = np.where(fitted.is_in_front, np.abs(fitted.residuals_px), np.inf)
    inlier_mask = residuals < config.max_error_px
    reason = REASON_OF_VERDICT[fitted.verdict]
    if inlier_mask.sum() < config.needed_inliers(5, 1):
        reason = Reason.TOO_FEW_INLIERS
    raw = found.raw.copy()
    raw[:9], raw[9:12] = fitted.rotation.ravel(), fitted.translation
    return replace(
        found,
        reason=reason,
        raw=raw,
        residuals=residuals,
        inlier_mask=inlier_mask,
        score=float(np.minimum(residuals, config.max_error_px) @ np.minimum(residuals, config.max_error_px)),
        noise=fitted.noise_px,
        covariance=fitted.covariance if reason is Reason.OK else undetermined,
    )


def _fit_upright_motion(
    pixels1: Any,
    pixels2: Any,
    cameras: tuple[Camera, Camera],
    upright: tuple[np.ndarray, np.ndarray],
    config: RansacConfig,
) -> Found:
    y1, y2 = rays_on_plane(cameras[0], pixels1, "pixels1"), rays_on_plane(cameras[1], pixels2, "pixels2")
    n = require_same_length(pixels1=y1, pixels2=y2)
    matches = np.concatenate([y1, y2], axis=1)
    order = random_order(usable_rows(matches), config)
    problem = UprightMotionProblem(np.ascontiguousarray(matches[order].T), *upright)
    scale_px = 2.0 / (1.0 / cameras[0].focal_px + 1.0 / cameras[1].focal_px)
    return run_loop(problem, order, n, scale_px, config, None)


def _off_a_line(found: Found, one: _OnePair) -> Found:
    """Degenerate if the inliers lie within their noise of one line, in either image."""
    if found.reason is not Reason.OK:
        return found
    inliers = one.pairs.pixels[:, found.inlier_mask]
    if not any(lie_on_a_line(inliers[side : side + 2].T, found.noise) for side in (0, 2)):
        return found
    return replace(found, reason=Reason.DEGENERATE, covariance=np.full_like(found.covariance, np.inf))


def _is_explained_by_a_plane(one: _OnePair, config: RansacConfig) -> bool:
    """Whether F is supported by a plane, and by no more matches off it than by chance.

    Any two matches off the plane define an epipole: the pair with most support must exceed the support of which chance is
    expected to give a tenth of one pair (a contrario: Moisan and Stival, IJCV 2004). None of 800 noisy planes passed as a scene
    with depth; scenes with few points off the plane may pass as planes.
    """
    center, spread = one.fits.frame[0, :4, None], one.fits.frame[0, 4]
    items = np.ascontiguousarray((one.pairs.pixels[:, one.use] - center) / spread)
    max_error_sq = (config.max_error_px / spread) ** 2
    fraction, num_off, agreed, chance = parallax_support(one.fits.raw[0], items, max_error_sq, np.uint64(0))
    if fraction < _ALL_BUT_CHANCE:
        return False
    pairs = 0.5 * num_off * (num_off - 1)
    return bool(agreed < 3 or bdtrc(agreed - 3, num_off - 2, chance) * pairs > 0.1)


def _twist_covariance(found: Found) -> np.ndarray:
    """Covariance of (rotation, step of t in its tangent plane) to that of xi in exp(xi) @ motion: dt = rho + phi x t."""
    t = found.raw[9:12]
    if not (np.isfinite(found.covariance).all() and np.isfinite(t).all()):
        return np.full((6, 6), np.inf)
    basis = np.empty((2, 3))
    tangent_of_direction(t, basis)
    lift = np.zeros((6, 5))
    lift[3:, :3] = np.eye(3)
    lift[:3, 3:] = basis.T
    lift[:3, :3] = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])  # -(phi x t) = [t]x phi
    return lift @ found.covariance @ lift.T


def _entries_of_fundamental(raw: np.ndarray) -> np.ndarray:
    """(9, 7): derivatives of the entries of F by its seven parameters."""
    d = np.zeros((7, 9))
    derivatives_of_fundamental(raw, d)
    return d.T


def _projected(jacobian: np.ndarray, model: np.ndarray, found: Found) -> np.ndarray:
    """Covariance of the entries of model / |model| from that of the parameters."""
    if not np.isfinite(found.covariance).all():
        return np.full((9, 9), np.inf)
    unit = model.ravel() / np.linalg.norm(model)
    across = (np.eye(9) - np.outer(unit, unit)) @ jacobian
    return across @ found.covariance @ across.T
