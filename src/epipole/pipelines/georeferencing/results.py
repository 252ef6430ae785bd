"""What is known about each surveyed point and the result, for `control_points.json` and `summary.json`."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from typing import Any

import numpy as np

from epipole.io.georeference import georeference_fields
from epipole.pipelines.georeferencing.georeference import GeoreferencedModel, PointRole
from epipole.pipelines.georeferencing.survey import SurveyedPoints
from epipole.scene import Georeference

AXES = ("east_m", "north_m", "up_m")
RMS_OF = (PointRole.CONTROL, PointRole.CHECK)


def point_entries(
    found: GeoreferencedModel, surveyed: SurveyedPoints, origin: Georeference | None
) -> dict[str, dict[str, Any]]:
    """Everything known about each surveyed point, by name."""
    out = {}
    lat_lon_alt = None
    if origin is not None and len(surveyed):
        lat_lon_alt = origin.lat_lon_alt_of(np.nan_to_num(found.adjusted.positions_m))
    for row, name in enumerate(surveyed.name):
        own = np.flatnonzero(surveyed.point == row)
        used = own[found.used_mask[own]]
        errors = found.adjusted.mark_errors_px[used]
        entry: dict[str, Any] = {
            "role": found.roles[row].value,
            "num_observations": len(own),
            "num_used": len(used),
            "error_px": float(np.sqrt(np.mean(errors**2))) if len(errors) else None,
            "measured_m": _by_axis(surveyed.position_m[row]),
        }
        if np.isfinite(found.adjusted.positions_m[row]).all():
            entry |= {
                "adjusted_m": _by_axis(found.adjusted.positions_m[row]),
                "residual_m": _by_axis(found.residuals_m[row]),
                "sigma_m": _by_axis(found.sigmas_m[row]),
            }
            if np.isfinite(found.others_residuals_m[row]).all():
                entry |= {
                    "residual_from_others_m": _by_axis(found.others_residuals_m[row]),
                    "sigma_from_others_m": _by_axis(found.others_sigmas_m[row]),
                }
            if lat_lon_alt is not None:
                entry["adjusted_lat_lon_alt"] = lat_lon_alt[row].tolist()
        out[name] = entry
    return out


def with_sigma(origin: Georeference | None, found: GeoreferencedModel) -> Georeference | None:
    """The origin with the standard deviations of a position in the model; without them if they are undetermined."""
    sigma_m = np.nanmedian(_image_sigmas(found), axis=0)
    if origin is None or not np.isfinite(sigma_m).all():
        return origin
    return replace(origin, sigma_m=(float(sigma_m[0]), float(sigma_m[1]), float(sigma_m[2])))


def image_table(found: GeoreferencedModel, origin: Georeference | None) -> str:
    """The registered images as CSV: position in meters with standard deviations, and latitude, longitude and altitude if known."""
    model = found.model
    rows = np.flatnonzero(model.is_registered())
    centers, sigmas = model.camera_centers_in_world()[rows], _image_sigmas(found)[rows]
    columns = ["image", *AXES, *(f"sigma_{axis}" for axis in AXES)]
    values = np.concatenate([centers, sigmas], axis=1)
    if origin is not None:
        columns += ["latitude_deg", "longitude_deg", "altitude_m"]
        values = np.concatenate([values, origin.lat_lon_alt_of(centers)], axis=1)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row, numbers in zip(rows.tolist(), values.tolist()):
        known = [repr(round(v, 10)) if np.isfinite(v) else "" for v in numbers]
        writer.writerow([model.images.name[row], *known])
    return text.getvalue()


def _image_sigmas(found: GeoreferencedModel) -> np.ndarray:
    """(n, 3) standard deviations of the images' positions; infinite if undetermined, NaN if not registered."""
    return np.asarray(np.sqrt(np.einsum("nii->ni", found.adjusted.center_covariances)))


def summary_of(found: GeoreferencedModel, origin: Georeference | None) -> dict[str, Any]:
    """The result in numbers."""
    roles = [role.value for role in found.roles]
    model = found.model
    sigmas = _image_sigmas(found)
    horizontal = np.hypot(found.gps_residuals_m[:, 0], found.gps_residuals_m[:, 1])
    num_gps = int(np.isfinite(horizontal).sum())
    return {
        "is_metric": True,
        "georeference": None if origin is None else georeference_fields(origin),
        "anchor": {"scale": 1.0, "relative_sigma": _relative_sigma(found)},
        "num_images": int(model.is_registered().sum()),
        "num_points": len(model.points),
        **{f"num_{role.value}": roles.count(role.value) for role in PointRole},
        "rms_m": {role.value: _by_axis(found.rms_m(role)) for role in RMS_OF},
        "fraction_within_two_sigma": _within(found),
        "num_gps": num_gps,
        "median_gps_residual_m": float(np.nanmedian(horizontal)) if num_gps else None,
        "gps_offset_m": None if found.gps_offset_m is None else _by_axis(found.gps_offset_m),
        "median_image_sigma_m": _by_axis(np.nanmedian(sigmas, axis=0)),
        "num_undetermined_images": int(np.isinf(sigmas).any(axis=1).sum()),
        "mean_error_px": model.mean_reprojection_error_px(),
        "noise_px": found.adjusted.noise_px,
    }


def _relative_sigma(found: GeoreferencedModel) -> float | None:
    """Standard deviation of a length, about that of an image's position relative to the extent of the images; None if unknown."""
    variances = np.einsum("nii->ni", found.adjusted.center_covariances)
    centers = found.model.camera_centers_in_world()
    extent = float(np.linalg.norm(np.nanmax(centers, axis=0) - np.nanmin(centers, axis=0)))
    sigma = float(np.sqrt(np.nanmedian(variances.max(axis=1))))
    return sigma / extent if extent > 0 and np.isfinite(sigma) and sigma < extent else None


def _within(found: GeoreferencedModel) -> float | None:
    """Fraction of the coordinates of check points that are within two standard deviations; None without check points."""
    rows = [row for row, role in enumerate(found.roles) if role is PointRole.CHECK]
    ratio = np.abs(found.residuals_m[rows] / found.sigmas_m[rows])
    ratio = ratio[np.isfinite(ratio)]
    return float((ratio <= 2.0).mean()) if len(ratio) else None


def _by_axis(values: np.ndarray) -> dict[str, float | None]:
    return {axis: float(v) if np.isfinite(v) else None for axis, v in zip(AXES, values.tolist())}
