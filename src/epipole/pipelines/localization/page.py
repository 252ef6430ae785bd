"""The report of a localization: key figures, the model with the localized images, and a line for each image."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from epipole.pipelines.localization.scene import scene_of_localized
from epipole.report.frame import render
from epipole.report.markup import count, number
from epipole.report.space import space_data
from epipole.report.space_model import MAX_POINTS
from epipole.scene import Reconstruction


def render_page(
    warnings: Sequence[str],
    model: Reconstruction,
    localized: Collection[str],
    entries: Mapping[str, Mapping[str, Any]],
    reasons: Mapping[str, str],
    unit: str,
) -> str:
    """One self-contained HTML page.

    Args:
        warnings: shown above the model.
        model: the model with the localized images.
        localized: their names in it.
        entries: what `localized.json` says about each image.
        reasons: reason for each image that is not localized.
        unit: unit of lengths; empty if the scale is unknown.
    """
    good = {name: entry for name, entry in entries.items() if entry["is_localized"]}
    scene = scene_of_localized(model, localized, title="Localized images", unit=unit)
    return render(
        __package__,
        "localization.html.jinja",
        title="Localized images",
        num_localized=len(good),
        num_images=len(good) + len(reasons),
        tiles=_tiles(good, len(good) + len(reasons), unit or "model units"),
        unit=unit or "model units",
        warnings=list(warnings),
        space=space_data(scene, MAX_POINTS),
        rows=[_row(name, entry) for name, entry in good.items()],
        reasons=[
            (name, why, _evidence(entries[name]) if name in entries else "") for name, why in reasons.items()
        ],
    )


def _tiles(good: Mapping[str, Mapping[str, Any]], total: int, unit: str) -> list[tuple[str, str, str]]:
    """Name, value and unit of the key figures."""

    def median(key: str) -> float:
        return float(np.median([entry[key] for entry in good.values()])) if good else float("nan")

    return [
        ("Images localized", count(len(good)), f"of {count(total)}"),
        ("Median position sigma", _digits(median("position_sigma")), unit),
        ("Median rotation sigma", _digits(median("rotation_sigma_deg")), "degrees"),
        ("Median reprojection error", number(median("error_px")), "px"),
        ("Median number of points", count(int(median("num_points"))) if good else "0", ""),
    ]


def _row(name: str, entry: Mapping[str, Any]) -> tuple[str, ...]:
    x, y, z = entry["position_in_world"]
    return (
        name,
        ", ".join(number(value, 3) for value in (x, y, z)),
        _digits(entry["position_sigma"]),
        _digits(entry["rotation_sigma_deg"]),
        f"{entry['num_points']:,}",
        number(entry["error_px"]),
        f"{number(entry['camera']['params'][0], 0)} px, {entry['focal_source']}",
    )


def _evidence(entry: Mapping[str, Any]) -> str:
    return f"{entry['num_matches']:,} matches, {entry['num_inliers']:,} of them agree with one pose"


def _digits(value: float) -> str:
    """A standard deviation with two digits."""
    return f"{value:.2g}" if np.isfinite(value) else number(value)
