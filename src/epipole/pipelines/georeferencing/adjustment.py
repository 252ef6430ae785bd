"""Bundle adjustment of a model with control points and GPS, and what it says about the survey.

    min  sum rho(|project(X_j) - pixel_ij|^2 / sigma_px^2) + sum rho_m(|project(Y_k) - mark_ik|^2 / sigma_mark^2)
         + sum |(Y_k - measured_k) / sigma_k|^2  +  sum rho_g(|(c_i - gps_i) / sigma_gps|^2)

over poses, intrinsics, points X of the model and control points Y. Check points have marks, but no measured position.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64
from scipy.special import chdtri

from epipole.cameras import CameraModel
from epipole.mapping import Freedom, bundle_problem_of, with_adjustment
from epipole.mapping.adjustment import DISTORTION_SIGMA, TRUSTED_FOCAL_SIGMA
from epipole.optim import (
    BundleCovariance,
    BundlePriors,
    BundleProblem,
    BundleResult,
    PointPositions,
    adjust_bundle,
    bundle_covariance,
    with_fixed_gauge,
)
from epipole.pipelines.georeferencing.survey import GpsFixes, SurveyedPoints
from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.mappers.incremental import final_bundle
from epipole.pipelines.sfm.mapping_stage import UNKNOWN_ALTITUDE_SIGMA_M
from epipole.scene import Cameras, Reconstruction
from epipole.scene.point_accuracy import pixel_noise

CHANCE = 1e-3
"""Probability that correct control points of a survey are rejected."""
MIN_TO_REJECT = 5
"""Control points from which one that contradicts the others can be identified: seven numbers are those of the similarity."""
MARK_SIGMAS = 5.0
"""Residual of a mark, in standard deviations, above which it is rejected."""
LEAST_NOISE_PX = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """A model adjusted with control points and GPS."""

    model: Reconstruction
    positions_m: Float64[np.ndarray, "n 3"]
    """Control and check points; NaN if fewer than two images show them."""
    covariances: Float64[np.ndarray, "n 3 3"]
    """Of `positions_m`; NaN if unknown."""
    independent_covariances: Float64[np.ndarray, "n 3 3"]
    """The same if the errors of all pixels are independent, which tests of the survey need: they compare it with the measurements'."""
    mark_errors_px: Float64[np.ndarray, " k"]
    """Reprojection error of each observation; NaN if it was not used."""
    center_covariances: Float64[np.ndarray, "i 3 3"]
    """Of the camera centers; NaN if not registered, infinite if undetermined."""
    noise_px: float
    mark_sigma_px: float


def adjust_with_survey(
    model: Reconstruction,
    surveyed: SurveyedPoints,
    points_m: Float64[np.ndarray, "n 3"],
    used_mask: Bool[np.ndarray, " k"],
    gps: GpsFixes | None,
    *,
    mark_sigma_px: float,
    freedom: Freedom,
) -> Adjusted:
    """Adjust a model that is in meters east, north and up, at least approximately.

    Args:
        model: the model.
        surveyed: control points and check points.
        points_m: initial positions of these points; NaN rows are not used.
        used_mask: observations of these points that are used.
        gps: GPS positions of the images.
        mark_sigma_px: standard deviation of the marks.
        freedom: intrinsics that may change.
    """
    noise_px = max(pixel_noise(model), LEAST_NOISE_PX)
    rows = np.flatnonzero(np.isfinite(points_m).all(axis=1))
    problem = _with_points(bundle_problem_of(model, freedom), model, surveyed, points_m, rows, used_mask)
    num_model = len(model.points)
    sigma_px = np.ones(num_model + len(rows))
    sigma_px[num_model:] = mark_sigma_px / noise_px
    is_measured = surveyed.is_control[rows, None] & np.isfinite(surveyed.position_m[rows])
    expected = PointPositions(
        np.arange(num_model, num_model + len(rows)),
        surveyed.position_m[rows],
        np.where(is_measured, surveyed.sigma_m[rows] / noise_px, np.inf),
    )
    priors = _priors(model, gps, expected, noise_px)
    problem = with_fixed_gauge(replace(problem, priors=priors, point_sigma_px=sigma_px))
    config = replace(
        final_bundle(MapperConfig(), float(np.median(model.reprojection_errors_px()))),
        function_tolerance=1e-7,
    )
    result = adjust_bundle(problem, config)
    plain = bundle_covariance(problem, result, config, noise_px=noise_px)
    found = bundle_covariance(problem, result, config, noise_px=noise_px, clustered=True)
    adjusted = _adjusted(model, surveyed, result, found, rows, used_mask, (noise_px, mark_sigma_px))
    adjusted.independent_covariances[rows] = plain.points_in_world[num_model:]
    return adjusted


def contradicting_point(adjusted: Adjusted, surveyed: SurveyedPoints) -> int | None:
    """The control point that contradicts the others most; None if none does so significantly, or it cannot be identified.

    The residual v = adjusted - measured has the covariance C_measured - C_adjusted; v^T C^-1 v is chi-squared if the survey is
    correct (data snooping: Baarda, A testing procedure for use in geodetic networks, 1968).
    """
    is_determined = np.isfinite(adjusted.independent_covariances).all(axis=(1, 2))
    rows = np.flatnonzero(surveyed.is_control & is_determined)
    if len(rows) < MIN_TO_REJECT:
        return None
    scores = np.zeros(len(rows))
    for n, row in enumerate(rows):
        known = np.flatnonzero(np.isfinite(surveyed.position_m[row]))
        off = (adjusted.positions_m[row] - surveyed.position_m[row])[known]
        measured = surveyed.sigma_m[row, known]
        own = np.diag(measured**2) - adjusted.independent_covariances[row][np.ix_(known, known)]
        white = own / np.outer(measured, measured)
        values, vectors = np.linalg.eigh(white)
        # Directions without redundancy, in which the point alone determines the model, show no error.
        usable = values > 1e-3
        parts = (vectors.T @ (off / measured))[usable] ** 2 / values[usable]
        limit = chdtri(max(int(usable.sum()), 1), CHANCE / len(rows))
        scores[n] = parts.sum() / limit
    worst = int(np.argmax(scores))
    return int(rows[worst]) if scores[worst] > 1.0 else None


def without_itself(
    adjusted: Adjusted, surveyed: SurveyedPoints
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """Residual of each control point against the position that all other measurements give it, and its standard deviation.

    From C^-1 = C_measured^-1 + C_others^-1, the information filter backwards. NaN for check points, which have no part in the result,
    and where the others do not determine the position.
    """
    residual, sigma = np.full((2, len(surveyed), 3), np.nan)
    for row in np.flatnonzero(surveyed.is_control & np.isfinite(adjusted.positions_m).all(axis=1)):
        is_known = np.isfinite(surveyed.position_m[row]).all()
        if not (is_known and np.isfinite(adjusted.independent_covariances[row]).all()):
            continue
        measured = np.diag(surveyed.sigma_m[row] ** -2.0)
        information = np.linalg.inv(adjusted.independent_covariances[row]) - measured
        values = np.linalg.eigvalsh(information * np.outer(surveyed.sigma_m[row], surveyed.sigma_m[row]))
        if not values.min() > 1e-4:
            continue
        others = np.linalg.inv(information)
        off = adjusted.positions_m[row] - surveyed.position_m[row]
        residual[row] = off + others @ measured @ off
        sigma[row] = np.sqrt(np.diag(others) + surveyed.sigma_m[row] ** 2)
    return residual, sigma


def contradicting_marks(errors: Float64[np.ndarray, " k"], mark_sigma_px: float) -> Bool[np.ndarray, " k"]:
    """Observations whose residual is much larger than their standard deviation and the usual residual.

    Args:
        errors: distances in pixels from points that only the observations determine, so that a wrong coordinate of a control point
            does not count against its observations; NaN if not used.
        mark_sigma_px: standard deviation of an observation.
    """
    known = errors[np.isfinite(errors)]
    usual = float(np.median(known)) if len(known) else 0.0
    limit = MARK_SIGMAS * max(mark_sigma_px, usual)
    return np.isfinite(errors) & (errors > limit)


def _with_points(
    problem: BundleProblem,
    model: Reconstruction,
    surveyed: SurveyedPoints,
    points_m: np.ndarray,
    rows: np.ndarray,
    used_mask: np.ndarray,
) -> BundleProblem:
    """The problem with the surveyed points after the model's."""
    marks = np.flatnonzero(used_mask & np.isin(surveyed.point, rows))
    marks = marks[np.argsort(surveyed.point[marks], kind="stable")]
    counts = np.bincount(surveyed.point[marks], minlength=len(surveyed))[rows]
    image = surveyed.image[marks]
    return replace(
        problem,
        points_in_world=np.concatenate([problem.points_in_world, points_m[rows]]),
        point_free=np.ones(len(problem.point_free) + len(rows)),
        offsets=np.concatenate([problem.offsets, problem.offsets[-1] + np.cumsum(counts)]).astype(np.int64),
        frame=np.concatenate([problem.frame, model.images.frame[image]]).astype(np.int32),
        sensor=np.concatenate([problem.sensor, model.images.sensor[image]]).astype(np.int32),
        camera=np.concatenate([problem.camera, model.camera_of_image[image]]).astype(np.int32),
        pixels=np.concatenate([problem.pixels, surveyed.pixels[marks]]),
    )


def _priors(
    model: Reconstruction, gps: GpsFixes | None, points: PointPositions, noise_px: float
) -> BundlePriors:
    """Priors with standard deviations relative to the noise, as the adjustment weighs them against pixels of unit noise."""
    expected, sigma = _expected_params(model.cameras)
    position, position_sigma = None, np.ones((len(model.frames), 3))
    if gps is not None:
        position = np.full((len(model.frames), 3), np.nan)
        # The center of a frame is that of its reference camera, whose pose in the rig is the identity.
        offset = np.linalg.norm(model.rigs.cam_from_rig.translation, axis=1)
        rows = np.flatnonzero(
            model.is_registered()
            & (offset[model.images.sensor] == 0.0)
            & np.isfinite(gps.position_m[:, :2]).all(axis=1)
        )
        frames = model.images.frame[rows]
        known = gps.position_m[rows]
        has_altitude = np.isfinite(known[:, 2])
        position[frames] = np.where(has_altitude[:, None], known, known * [1.0, 1.0, 0.0])
        position[frames[~has_altitude], 2] = 0.0
        position_sigma[frames] = gps.sigma_m[rows] / noise_px
        position_sigma[frames[~has_altitude], 2] = UNKNOWN_ALTITUDE_SIGMA_M / noise_px
    return BundlePriors(
        position_in_world=position,
        position_sigma=position_sigma,
        params_expected=expected,
        params_sigma=sigma / noise_px,
        points=points,
    )


def _expected_params(cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Weak priors: they matter for cameras that few points determine."""
    expected, sigma = cameras.params.copy(), np.full(cameras.params.shape, np.inf)
    for c in range(len(cameras)):
        kind = CameraModel(int(cameras.model[c]))
        focal = list(kind.focal_indices)
        sigma[c, focal] = TRUSTED_FOCAL_SIGMA * cameras.params[c, focal]
        sigma[c, list(kind.distortion_indices)] = DISTORTION_SIGMA
    return expected, sigma


def _adjusted(
    model: Reconstruction,
    surveyed: SurveyedPoints,
    result: BundleResult,
    covariance: BundleCovariance,
    rows: np.ndarray,
    used_mask: np.ndarray,
    noise: tuple[float, float],
) -> Adjusted:
    num_model = len(model.points)
    moved = with_adjustment(model, result)
    positions, covariances = np.full((len(surveyed), 3), np.nan), np.full((len(surveyed), 3, 3), np.nan)
    positions[rows] = result.points_in_world[num_model:]
    covariances[rows] = covariance.points_in_world[num_model:]
    return Adjusted(
        moved,
        positions,
        covariances,
        np.full_like(covariances, np.nan),
        mark_errors(moved, surveyed, positions, used_mask),
        _center_covariances(moved, covariance.rig_from_world),
        *noise,
    )


def mark_errors(
    model: Reconstruction, surveyed: SurveyedPoints, points_m: np.ndarray, used_mask: np.ndarray
) -> Float64[np.ndarray, " k"]:
    """Reprojection error of each observation of the surveyed points; NaN if it is not used."""
    out = np.full(len(surveyed.point), np.nan)
    cams = model.cams_from_world()
    for k in np.flatnonzero(used_mask & np.isfinite(points_m[surveyed.point]).all(axis=1)):
        image = int(surveyed.image[k])
        camera = model.cameras[int(model.camera_of_image[image])]
        pixel = camera.project(cams[image].apply(points_m[surveyed.point[k]][None]))[0]
        out[k] = np.linalg.norm(pixel - surveyed.pixels[k])
    return out


def _center_covariances(model: Reconstruction, of_frames: np.ndarray) -> Float64[np.ndarray, "i 3 3"]:
    """Covariances of the centers -R^T t of reference cameras: d center / d translation tangent = -R^T."""
    poses = model.frames.rig_from_world
    rotated = np.swapaxes(poses.rotation, 1, 2)
    registered = model.frames.is_registered()
    known = registered & np.isfinite(of_frames).all(axis=(1, 2))
    of_centers = np.full((len(registered), 3, 3), np.inf)
    of_centers[known] = rotated[known] @ of_frames[known, :3, :3] @ poses.rotation[known]
    of_centers[~registered] = np.nan
    return np.asarray(of_centers[model.images.frame])
