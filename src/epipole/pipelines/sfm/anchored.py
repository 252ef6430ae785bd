"""Metric scale for the largest model, from GPS, measured positions, known lengths, tags, boards, odometry or an IMU."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from epipole.errors import DegenerateGeometryError, EpipoleError, FileFormatError
from epipole.geometry import Similarity3
from epipole.io.files import read_json
from epipole.io.images.photographs import read_gray
from epipole.mapping import adjust_reconstruction
from epipole.optim import BundlePriors
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.pipelines.sfm.gps.alignment import gps_distances
from epipole.pipelines.sfm.mappers.incremental import final_bundle
from epipole.pipelines.sfm.mapping_stage import Mapped
from epipole.pipelines.sfm.photographs import ImageSet
from epipole.pipelines.sfm.pipeline import Solution
from epipole.runs import Progress, ProgressCallback
from epipole.scale import (
    Anchoring,
    MetricScale,
    ScaleEstimate,
    after_adjustment,
    anchor_model,
    views_of_model,
)
from epipole.scene import Reconstruction

UP_TO_SCALE = "up to scale: images alone do not determine lengths"


def with_scale(
    solution: Solution,
    config: ReconstructConfig,
    progress: ProgressCallback,
    known: ScaleEstimate | None = None,
) -> tuple[Mapped, list[str]]:
    """Scale the largest model to meters, if its scale can be determined; also returns warnings.

    Args:
        solution: the models.
        config: options with the known measurements.
        progress: called with each image that is searched for objects of known size.
        known: scale of the largest model from its rigs, or from the model from which it grew; it counts unless GPS gives the scale.

    Raises:
        FileFormatError: a file given as an option cannot be read.
    """
    mapped, images = _with_residuals(solution.mapped, solution.images), solution.images
    model, gps = mapped.models[0], gps_estimate(mapped, images, config)
    if known is not None and (gps is None or known.kind == "rig"):
        gps = known
    if config.anchors.is_empty:
        return replace(mapped, scale=_of_gps(gps)), []

    searched: set[int] = set()
    num_images = int(model.is_registered().sum())
    progress(Progress("anchor", 0, num_images))

    def gray(row: int) -> np.ndarray | None:
        searched.add(row)
        progress(Progress("anchor", min(len(searched), num_images - 1), num_images))
        try:
            return read_gray(images.folder / images.names[row])
        except EpipoleError:
            return None

    views = views_of_model(model, gray)
    try:
        found = anchor_model(views, config.anchors, others=[] if gps is None else [gps])
    except DegenerateGeometryError as error:
        words = "the model stays up to scale" if gps is None else "the scale stays that of GPS"
        return replace(mapped, scale=_of_gps(gps)), [f"{words}: {error}"]
    model, alignment = _moved(model, found, config), mapped.gps[0]
    progress(Progress("anchor", num_images, num_images))
    georeference = mapped.models[0].georeference if found.positions is None else None
    if alignment is not None:
        residuals_m = gps_distances(model.camera_centers_in_world(), _fixes(mapped, images))
        alignment = replace(alignment, residuals_m=residuals_m) if found.positions is None else None
    return (
        replace(
            mapped,
            models=(replace(model, georeference=georeference), *mapped.models[1:]),
            gps=(alignment, *mapped.gps[1:]),
            scale=found.scale,
        ),
        found.scale.warnings(),
    )


def _with_residuals(mapped: Mapped, images: ImageSet) -> Mapped:
    """With the present distances of the largest model from GPS: an adjustment with rigs has moved its images."""
    if mapped.gps[0] is None:
        return mapped
    residuals_m = gps_distances(mapped.models[0].camera_centers_in_world(), _fixes(mapped, images))
    return replace(mapped, gps=(replace(mapped.gps[0], residuals_m=residuals_m), *mapped.gps[1:]))


def scale_of_workspace(workspace: Path) -> ScaleEstimate | None:
    """Scale of a finished model in meters, according to its summary; None if it is up to scale or unknown."""
    try:
        summary = read_json(workspace / "summary.json")
    except FileFormatError:
        return None
    anchor = summary.get("anchor") if isinstance(summary, dict) else None
    sigma = anchor.get("relative_sigma") if isinstance(anchor, dict) else None
    if not isinstance(sigma, float) or not 0 <= sigma < 1:
        return None
    return ScaleEstimate("earlier model", "earlier model", 1.0, sigma, 0.0, "scale of the earlier model")


def _moved(model: Reconstruction, found: Anchoring, config: ReconstructConfig) -> Reconstruction:
    """Scale the model to meters; measured positions also enter another adjustment as factors."""
    model = model.transformed(_about_middle(model, found))
    if found.positions is None:
        return model
    rows = np.flatnonzero(model.is_registered())
    before = model.camera_centers_in_world()[rows]
    expected = np.full((len(model.frames), 3), np.nan)
    expected[model.images.frame[rows]] = found.positions.positions
    priors = BundlePriors(position_in_world=expected, position_sigma=found.positions.sigma)
    bundle = final_bundle(config.mapper, float(np.median(model.reprojection_errors_px())))
    adjusted, _ = adjust_reconstruction(model, bundle, priors=priors)
    return adjusted.transformed(after_adjustment(found, before, adjusted.camera_centers_in_world()[rows]))


def _about_middle(model: Reconstruction, found: Anchoring) -> Similarity3:
    """Without measured positions, scale about the center of the cameras, to keep a GPS alignment in position."""
    if found.positions is not None:
        return found.world_from_model
    middle = np.nanmean(model.camera_centers_in_world(), axis=0)
    scale = float(found.world_from_model.scale)
    return Similarity3(np.asarray(scale), np.eye(3), middle - scale * middle)


def _of_gps(gps: ScaleEstimate | None) -> MetricScale | None:
    return None if gps is None else MetricScale(gps.scale, gps.sigma, (gps,), np.ones(1, bool))


def _fixes(mapped: Mapped, images: ImageSet) -> np.ndarray:
    """GPS positions in the coordinates of the largest model, which GPS has aligned."""
    origin = mapped.models[0].georeference
    return np.full((len(images), 3), np.nan) if origin is None else origin.enu_of(images.lat_lon_alt)


def gps_estimate(mapped: Mapped, images: ImageSet, config: ReconstructConfig) -> ScaleEstimate | None:
    """Scale estimate of the largest model, if GPS has made it metric: one, with its standard deviation."""
    if mapped.gps[0] is None:
        return None
    centers, fixes = mapped.models[0].camera_centers_in_world(), _fixes(mapped, images)
    fixes = np.where(np.isfinite(fixes), fixes, np.where(np.isfinite(fixes[:, :1]), centers, np.nan))
    rows = np.flatnonzero(np.isfinite(fixes).all(axis=1) & np.isfinite(centers).all(axis=1))
    spread = float(np.sqrt(((centers[rows] - centers[rows].mean(axis=0)) ** 2).sum()))
    off = np.linalg.norm(centers[rows] - fixes[rows], axis=1)
    each = max(config.mapper.gps_sigma_m, float(np.median(off)))
    words = f"GPS of {len(rows)} images"
    return ScaleEstimate("GPS", "GPS", 1.0, each / max(spread, 1e-9), 0.0, words)
