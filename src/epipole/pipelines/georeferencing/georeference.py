"""Georeferencing of a model: alignment, adjustment with the survey, rejection of what contradicts it, and error bars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float64

from epipole._checks import checked
from epipole.errors import ConfigError
from epipole.mapping import Freedom
from epipole.pipelines.georeferencing.adjustment import (
    MARK_SIGMAS,
    Adjusted,
    adjust_with_survey,
    contradicting_marks,
    contradicting_point,
    mark_errors,
    without_itself,
)
from epipole.pipelines.georeferencing.config import GeoreferenceConfig
from epipole.pipelines.georeferencing.heights import SURFACES, common_height_m
from epipole.pipelines.georeferencing.start import find_start
from epipole.pipelines.georeferencing.survey import GpsFixes, SurveyedPoints
from epipole.robust import triangulate_points
from epipole.scene import Reconstruction

MAX_MARK_ERROR_PX = 12.0
"""Observations farther from the point that the others give are rejected before the adjustment, which moves a model by less."""
BROKEN, BROKEN_PX = 2.0, 2.0
"""Growth of the mean reprojection error, and least error, above which the survey contradicts the images."""
MARK_RMS = 4.0
"""RMS error of the observations of a control point, in their standard deviations, above which its coordinates contradict them."""
CONTROL_SIGMAS = 4.0
"""Residual of a control point against all others, or of a check point, in standard deviations, above which a warning is given."""
MOST_NAMED = 3
"""Check points with a warning of their own."""


class PointRole(StrEnum):
    """What a surveyed point was used for."""

    CONTROL = "control"
    """Determines the result."""
    CHECK = "check"
    """Checks the result."""
    REJECTED = "rejected"
    """A control point that contradicts the others."""
    UNSEEN = "unseen"
    """Fewer than two images show it, or their observations contradict each other."""


@dataclass(frozen=True, slots=True, eq=False)
class GeoreferencedModel:
    """A model in meters east, north and up, and how well it agrees with the survey."""

    model: Reconstruction
    roles: tuple[PointRole, ...]
    """Of each surveyed point."""
    adjusted: Adjusted
    used_mask: Bool[np.ndarray, " k"]
    """Observations of surveyed points that were used."""
    residuals_m: Float64[np.ndarray, "n 3"]
    """Adjusted minus measured position of each surveyed point; NaN if unknown."""
    sigmas_m: Float64[np.ndarray, "n 3"]
    """Standard deviation expected of these residuals for check points, of the adjusted position for control points."""
    others_residuals_m: Float64[np.ndarray, "n 3"]
    """Residual of each control point against the position that all other measurements give it; NaN if they do not."""
    others_sigmas_m: Float64[np.ndarray, "n 3"]
    """Standard deviations of these residuals."""
    gps_residuals_m: Float64[np.ndarray, "i 3"]
    """Camera minus GPS position of each image, without the offset; NaN if unknown."""
    gps_offset_m: Float64[np.ndarray, " 3"] | None
    """Constant offset of GPS from the control points; None if either is missing."""
    warnings: tuple[str, ...]

    def rms_m(self, role: PointRole) -> Float64[np.ndarray, " 3"]:
        """Root mean square of the residuals of the points with a role; NaN without such points."""
        own = self.residuals_m[[one is role for one in self.roles]]
        with np.errstate(invalid="ignore"):
            count = np.isfinite(own).sum(axis=0)
            return np.sqrt(np.nansum(own**2, axis=0) / np.where(count > 0, count, np.nan))


@checked
def georeference_model(
    model: Reconstruction, surveyed: SurveyedPoints, gps: GpsFixes | None, config: GeoreferenceConfig
) -> GeoreferencedModel:
    """Align a model with control points and GPS, and adjust it with them.

    Args:
        model: the model, in any coordinates.
        surveyed: control points and check points, in the coordinates of the result.
        gps: GPS positions of the images, in these coordinates.
        config: standard deviations and options.

    Raises:
        ConfigError: neither control points nor GPS determine position, orientation and scale, or they contradict the images.
    """
    limit_px = max(MAX_MARK_ERROR_PX, MARK_SIGMAS * config.mark_sigma_px)
    used, triangulated = _triangulated(model, surveyed, np.ones(len(surveyed.point), bool), limit_px)
    start = find_start(model, surveyed, triangulated, gps, config.gps_sigma_m, config.seed)
    model = model.transformed(start.enu_from_world)
    freedom = Freedom(focal=config.refine_cameras, distortion=config.refine_cameras)
    warnings = [*start.warnings, *_unseen_warnings(surveyed, used, triangulated)]
    rejected: set[int] = set()
    points, current = start.enu_from_world.apply(triangulated), surveyed
    error_before_px = float(np.nanmean(model.reprojection_errors_px()))
    while True:  # each round rejects an observation or a control point, so it ends
        adjusted = adjust_with_survey(
            model,
            current,
            points,
            used,
            start.gps,
            mark_sigma_px=config.mark_sigma_px,
            freedom=freedom,
        )
        model = adjusted.model
        errors = mark_errors(model, current, _triangulated(model, current, used, limit_px)[1], used)
        wrong = contradicting_marks(errors, config.mark_sigma_px)
        point = contradicting_point(adjusted, current)
        if wrong.any():
            warnings += _mark_warnings(current, errors, model, wrong)
            used, points = _triangulated(model, current, used & ~wrong, limit_px)
        elif point is not None:
            rejected.add(point)
            current = current.without_control(point)
            points = adjusted.positions_m
        else:
            break
    _refuse_broken(model, error_before_px)
    for point in sorted(rejected):
        off_m = current.position_m[point] - adjusted.positions_m[point]
        warnings.append(_rejection(current.name[point], off_m))
    return _result(current, adjusted, used, rejected, start.gps, start.gps_offset_m, warnings)


def _refuse_broken(model: Reconstruction, error_before_px: float) -> None:
    """Refuse a model that the survey has bent until it no longer fits its images.

    Raises:
        ConfigError: the reprojection error has grown much.
    """
    error_px = float(np.nanmean(model.reprojection_errors_px()))
    if error_px > max(BROKEN * error_before_px, BROKEN_PX):
        raise ConfigError(
            f"the control points and GPS positions contradict the images: with them, the mean reprojection error grows from "
            f"{error_before_px:.2f} to {error_px:.2f} px; check their coordinates, heights and standard deviations"
        )


def _triangulated(
    model: Reconstruction, surveyed: SurveyedPoints, used: np.ndarray, limit_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Observations that agree with a point, and the points (n, 3); NaN if fewer than two agree."""
    points, kept = np.full((len(surveyed), 3), np.nan), np.zeros(len(surveyed.point), bool)
    cams = model.cams_from_world()
    for row in range(len(surveyed)):
        own = np.flatnonzero(used & (surveyed.point == row))
        if len(own) < 2:
            continue
        images = surveyed.image[own]
        found = triangulate_points(
            cams[images],
            [model.cameras[int(model.camera_of_image[i])] for i in images],
            surveyed.pixels[own][:, None, :],
            max_error_px=limit_px,
        )
        if found.success_mask[0]:
            points[row] = found.points_in_world[0]
            kept[own[found.inlier_mask[:, 0]]] = True
    return kept, points


def _result(
    surveyed: SurveyedPoints,
    adjusted: Adjusted,
    used: np.ndarray,
    rejected: set[int],
    gps: GpsFixes | None,
    gps_offset_m: np.ndarray | None,
    warnings: list[str],
) -> GeoreferencedModel:
    seen = np.isfinite(adjusted.positions_m).all(axis=1)
    others_m, others_sigma_m = without_itself(adjusted, surveyed)
    warnings = [*warnings, *_control_warnings(surveyed, adjusted, others_m, others_sigma_m)]
    roles = [PointRole.CONTROL if control else PointRole.CHECK for control in surveyed.is_control]
    for row in range(len(surveyed)):
        if not seen[row]:
            roles[row] = PointRole.UNSEEN
        elif row in rejected:
            roles[row] = PointRole.REJECTED
    variances = np.einsum("nii->ni", adjusted.covariances)
    is_checked = np.array([role is not PointRole.CONTROL for role in roles], bool)[:, None]
    variances = variances + np.where(is_checked, surveyed.sigma_m**2, 0.0)
    residuals_m, sigmas_m = adjusted.positions_m - surveyed.position_m, np.sqrt(variances)
    checks = np.array([role is PointRole.CHECK for role in roles], bool)
    warnings += _check_warnings(surveyed.name, residuals_m, sigmas_m, checks)
    centers = adjusted.model.camera_centers_in_world()
    off = np.full(centers.shape, np.nan) if gps is None else centers - gps.position_m
    return GeoreferencedModel(
        adjusted.model,
        tuple(roles),
        adjusted,
        used,
        residuals_m,
        sigmas_m,
        others_m,
        others_sigma_m,
        off,
        gps_offset_m,
        tuple(warnings),
    )


def _control_warnings(
    surveyed: SurveyedPoints, adjusted: Adjusted, others_m: np.ndarray, others_sigma_m: np.ndarray
) -> list[str]:
    """Control points whose coordinates contradict their observations or the other measurements, but were not rejected."""
    out = []
    for row in np.flatnonzero(surveyed.is_control & np.isfinite(adjusted.positions_m).all(axis=1)).tolist():
        errors = adjusted.mark_errors_px[surveyed.point == row]
        rms_px = float(np.sqrt(np.nanmean(errors**2)))
        ratio = float(np.nanmax(np.abs(others_m[row] / others_sigma_m[row]), initial=0.0))
        if rms_px > MARK_RMS * max(adjusted.mark_sigma_px, 2.0 * adjusted.noise_px):
            out.append(
                f"the observations of {surveyed.name[row]} are {rms_px:.1f} px from its coordinates: those of this control point, or of another "
                "one, are wrong"
            )
        elif ratio > CONTROL_SIGMAS:
            away_m = float(np.linalg.norm(others_m[row]))
            out.append(
                f"the control point {surveyed.name[row]} is {away_m:.2f} m from where the other measurements put it, {ratio:.0f} standard "
                "deviations: one of the control points is wrong, or they are less precise than stated"
            )
    return out


def _check_warnings(
    names: Sequence[str], residuals_m: np.ndarray, sigmas_m: np.ndarray, is_check: np.ndarray
) -> list[str]:
    """Check points that the result does not put where they were measured: a common height, or the farthest by name."""
    with np.errstate(invalid="ignore"):
        ratio = np.nan_to_num(np.abs(residuals_m / sigmas_m))
    rows = np.flatnonzero(is_check & (ratio.max(axis=1) > CONTROL_SIGMAS))
    constant_m = common_height_m(residuals_m[rows, 2])
    if constant_m is not None and (ratio[rows, :2] <= CONTROL_SIGMAS).all():
        return [
            f"{len(rows)} check points were measured {abs(constant_m):.1f} m {'lower' if constant_m > 0 else 'higher'} than the result "
            f"puts them, and fit horizontally; their heights and those of the other measurements do not go together: {SURFACES}"
        ]
    farthest, out = rows[np.argsort(-ratio[rows].max(axis=1), kind="stable")], []
    if len(farthest) > MOST_NAMED:
        out.append(
            f"{len(farthest)} check points are more than {CONTROL_SIGMAS:g} standard deviations from where the result puts them; the report "
            "lists all, and the farthest follow"
        )
    for row in farthest[:MOST_NAMED].tolist():
        east, north, up = (f"{value:+.2f}" for value in np.nan_to_num(-residuals_m[row]))
        out.append(
            f"the check point {names[row]} was measured {east} m east, {north} m north and {up} m up of where the result puts it, "
            f"{ratio[row].max():.0f} standard deviations: it, what determines the result, or the stated standard deviations are wrong"
        )
    return out


def _unseen_warnings(surveyed: SurveyedPoints, used: np.ndarray, triangulated: np.ndarray) -> list[str]:
    """Points that cannot be used, and observations that contradict the others of their point."""
    out = []
    counts = np.bincount(surveyed.point, minlength=len(surveyed))
    for row in np.flatnonzero(~np.isfinite(triangulated).all(axis=1)).tolist():
        why = {
            0: "no registered image shows it",
            1: "only one registered image shows it, and at least two are needed",
        }.get(int(counts[row]), "its observations do not agree on a point")
        out.append(f"the point {surveyed.name[row]} is not used: {why}")
    for k in np.flatnonzero(~used & np.isfinite(triangulated).all(axis=1)[surveyed.point]).tolist():
        name = surveyed.name[int(surveyed.point[k])]
        out.append(
            f"an observation of {name} at pixel {surveyed.pixels[k, 0]:.0f}, {surveyed.pixels[k, 1]:.0f} contradicts the others of this "
            "point, and is not used"
        )
    return out


def _mark_warnings(
    surveyed: SurveyedPoints, errors: np.ndarray, model: Reconstruction, wrong: np.ndarray
) -> list[str]:
    return [
        f"the observation of {surveyed.name[int(surveyed.point[k])]} in {model.images.name[int(surveyed.image[k])]} is "
        f"{errors[k]:.1f} px from where the other images show the point, and is not used"
        for k in np.flatnonzero(wrong).tolist()
    ]


def _rejection(name: str, off_m: np.ndarray) -> str:
    east, north, up = (f"{value:+.2f}" for value in np.nan_to_num(off_m))
    return (
        f"the control point {name} contradicts the others and is not used: its coordinates are off by {east} m east, {north} m north "
        f"and {up} m up, as the images show it"
    )


def require_something(surveyed: SurveyedPoints, gps: GpsFixes | None) -> None:
    """Check that there is anything to georeference with.

    Raises:
        ConfigError: there are neither control points nor GPS positions.
    """
    if not len(surveyed) and gps is None:
        raise ConfigError("the images have no GPS positions: pass --gcp FILE with control points")
