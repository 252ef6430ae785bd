"""The report of a georeferencing: accuracy at check points, residuals of each point, GPS, and the model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from epipole.pipelines.georeferencing.georeference import GeoreferencedModel, PointRole
from epipole.pipelines.georeferencing.results import AXES
from epipole.pipelines.georeferencing.scene import scene_of_survey
from epipole.pipelines.georeferencing.survey import SurveyedPoints
from epipole.report.frame import render
from epipole.report.markup import count, number
from epipole.report.space import space_data
from epipole.report.space_model import MAX_POINTS


def render_page(
    found: GeoreferencedModel,
    surveyed: SurveyedPoints,
    summary: Mapping[str, Any],
    entries: Mapping[str, Mapping[str, Any]],
) -> str:
    """One self-contained HTML page.

    Args:
        found: the result.
        surveyed: control points and check points.
        summary: the numbers of `summary.json`.
        entries: what `control_points.json` says about each point.
    """
    scene = scene_of_survey(found.model, entries, title="Georeferenced model")
    return render(
        __package__,
        "georeference.html.jinja",
        title="Georeferenced model",
        lead=_lead(summary),
        tiles=_tiles(summary),
        warnings=list(summary["warnings"]),
        space=space_data(scene, MAX_POINTS),
        rows=[_row(name, entry) for name, entry in sorted(entries.items(), key=_order)],
        num_checks=summary["num_check"],
        images=_image_rows(found),
        offset=_offset(summary),
        origin=_origin(summary),
        has_points=bool(len(surveyed)),
    )


def _lead(summary: Mapping[str, Any]) -> str:
    parts = []
    if summary["num_control"]:
        parts.append(f"{summary['num_control']} control points")
    if summary["num_gps"]:
        parts.append(f"{summary['num_gps']} GPS positions")
    return f"A model of {count(summary['num_images'])} images in meters east, north and up, from {' and '.join(parts) or 'its survey'}."


def _tiles(summary: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Name, value and unit of the key figures."""
    role = "check" if summary["num_check"] else "control"
    rms = summary["rms_m"][role]
    out = []
    if rms["east_m"] is not None:
        horizontal = float(np.hypot(rms["east_m"], rms["north_m"]))
        out.append((f"Horizontal RMS of {role} points", _meters(horizontal), "m"))
    if rms["up_m"] is not None:
        out.append((f"Vertical RMS of {role} points", _meters(rms["up_m"]), "m"))
    sigma = summary["median_image_sigma_m"]
    if sigma["east_m"] is not None:
        out.append(
            (
                "Median position sigma of an image",
                _meters(max(v for v in sigma.values() if v is not None)),
                "m",
            )
        )
    if summary["median_gps_residual_m"] is not None:
        out.append(("Median distance from GPS", _meters(summary["median_gps_residual_m"]), "m"))
    out.append(("Mean reprojection error", number(summary["mean_error_px"]), "px"))
    return out


def _order(item: tuple[str, Mapping[str, Any]]) -> int:
    """Control points first, then check points, then what is not used."""
    return [role.value for role in PointRole].index(item[1]["role"])


def _row(name: str, entry: Mapping[str, Any]) -> tuple[str, ...]:
    observations = f"{entry['num_used']} of {entry['num_observations']}"
    error = "" if entry["error_px"] is None else number(entry["error_px"])
    if "residual_m" not in entry:
        return (name, entry["role"], observations, "", "", "", "", error)
    residual, sigma = entry["residual_m"], entry["sigma_m"]
    values = ["" if residual[axis] is None else f"{residual[axis]:+.3f} ({sigma[axis]:.3f})" for axis in AXES]
    tested, deviation = residual, sigma
    if entry["role"] == "control":  # its own residual is small whatever its error
        tested = entry.get("residual_from_others_m", {})
        deviation = entry.get("sigma_from_others_m", {})
    ratios = [abs(tested[a] / deviation[a]) for a in AXES if tested.get(a) is not None and deviation[a]]
    worst = number(max(ratios), 1) if ratios else ""
    return (name, entry["role"], observations, *values, worst, error)


def _image_rows(found: GeoreferencedModel) -> list[tuple[str, ...]]:
    """The images farthest from their GPS position."""
    off = found.gps_residuals_m
    distance = np.hypot(off[:, 0], off[:, 1])
    rows = [k for k in np.argsort(-np.nan_to_num(distance, nan=-1.0)).tolist() if np.isfinite(distance[k])]
    return [
        (
            found.model.images.name[k],
            *("" if not np.isfinite(v) else f"{v:+.2f}" for v in off[k].tolist()),
            number(float(distance[k])),
        )
        for k in rows[:20]
    ]


def _offset(summary: Mapping[str, Any]) -> str:
    offset = summary["gps_offset_m"]
    if offset is None:
        return ""
    return ", ".join(
        f"{offset[axis]:+.2f} m {word}"
        for axis, word in zip(AXES, ("east", "north", "up"))
        if offset[axis] is not None
    )


def _origin(summary: Mapping[str, Any]) -> str:
    origin = summary["georeference"]
    if origin is None:
        return "The coordinates are those of the control points, whose position on Earth is unknown."
    crs = f" The control points are in {origin['crs']}." if origin["crs"] else ""
    return (
        f"The origin is at latitude {origin['lat_deg']:.8f}, longitude {origin['lon_deg']:.8f}, altitude {origin['alt_m']:.3f} m "
        f"(WGS84).{crs}"
    )


def _meters(value: float | None) -> str:
    """A length in meters with two digits."""
    return "unknown" if value is None or not np.isfinite(value) else f"{value:.2g}"
