"""Survey products in the report: shaded heights, the orthophoto, and figures of accuracy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from epipole.image import color_map
from epipole.io.survey.rasters import Raster
from epipole.pipelines.surfaces.survey_stage import Survey
from epipole.report.images import jpeg_uri
from epipole.report.markup import count

MOST_PX = 1000
"""Longer side of the images."""
SUN = np.array([-0.5, 0.5, 0.7071])
"""Direction toward the light of shaded heights: north-west, 45 degrees high (x east, y north, z up)."""
WHITE = 255


def survey_images(survey: Survey) -> list[tuple[str, str]]:
    """Captions and images: orthophoto, and shaded heights of the surface and of the ground."""
    known = survey.heights.values[np.isfinite(survey.heights.values)]
    span = f"{known.min():.1f} to {known.max():.1f} m"
    limits = float(known.min()), float(known.max())
    rgba = _small(survey.orthophoto.values)
    alpha = rgba[..., 3:].astype(np.float32) / 255.0
    photo = rgba[..., :3] * alpha + WHITE * (1.0 - alpha)
    return [
        ("orthophoto (orthophoto.tif)", jpeg_uri(np.rint(photo).astype(np.uint8))),
        (f"heights of the surface, {span} (dsm.tif)", jpeg_uri(shaded(survey.heights, limits))),
        ("heights of the ground, same colors (dtm.tif)", jpeg_uri(shaded(survey.terrain, limits))),
    ]


def shaded(raster: Raster, limits: tuple[float, float]) -> np.ndarray:
    """(h, w, 3) colors of heights with the shading of a light from the north-west; white where unknown."""
    known = np.isfinite(raster.values)
    values = np.where(known, raster.values, np.float32(np.nanmin(raster.values)))
    heights = _small(values)
    cell = raster.resolution_m * values.shape[0] / heights.shape[0]
    south, east = (
        np.gradient(heights, cell, axis=axis) if heights.shape[axis] > 1 else 0 * heights for axis in (0, 1)
    )
    normal = np.stack([-east, south, np.ones_like(heights)], axis=-1)
    light = np.clip((normal @ SUN) / np.linalg.norm(normal, axis=-1), 0.0, 1.0)
    scaled = np.clip((heights - limits[0]) / max(limits[1] - limits[0], 1e-6), 0.0, 1.0)
    colors = color_map(np.ascontiguousarray(1.0 + scaled, np.float32)) * (0.35 + 0.65 * light)[..., None]
    colors[_small(known.astype(np.uint8)) == 0] = WHITE
    return np.clip(np.rint(colors), 0, 255).astype(np.uint8)


def _small(image: np.ndarray) -> np.ndarray:
    factor = max(image.shape[:2]) / MOST_PX
    if factor <= 1.0:
        return image
    size = max(1, round(image.shape[1] / factor)), max(1, round(image.shape[0] / factor))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def survey_rows(survey: Survey, accuracy: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and values of the table: grid, area, and what is known about the accuracy of the model."""
    facts, (width, height) = survey.facts, survey.facts["raster_size"]
    rows = [
        ("coordinate system", facts["crs"]),
        ("ground sampling distance of the images (median)", f"{100 * facts['gsd_m']:.2g} cm"),
        ("grid", f"{count(width)} x {count(height)} cells of {100 * facts['resolution_m']:g} cm"),
        ("covered area", f"{count(round(facts['area_m2']))} m\u00b2"),
        ("contour lines every", f"{facts['contour_m']:g} m"),
    ]
    for role, words in (("control", "control points"), ("check", "check points")):
        rms = _entries(_entries(accuracy, "rms_m"), role)
        if all(isinstance(rms.get(axis), float) for axis in ("east_m", "north_m", "up_m")):
            text = ", ".join(f"{100 * rms[f'{axis}_m']:.1f} cm {axis}" for axis in ("east", "north", "up"))
            rows.append((f"{count(accuracy.get(f'num_{role}', 0))} {words}, root mean square", text))
    gps = accuracy.get("median_gps_residual_m")
    if isinstance(gps, float):
        images = f" of {count(accuracy['num_gps'])} images" if "num_gps" in accuracy else ""
        rows.append((f"GPS{images}, median horizontal residual", f"{gps:.2f} m"))
    return rows


def _entries(values: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Entries of a summary, which may be that of another program."""
    found = values.get(name)
    return found if isinstance(found, dict) else {}
