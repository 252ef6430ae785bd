"""Agreement of a reconstruction with the GPS fixes of its photographs, which are accurate to a few meters."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from benchmarks.tasks.sfm import SfmTask
from epipole.errors import DegenerateGeometryError
from epipole.geometry import Similarity3, align_points
from epipole.io.images.photographs import read_header
from epipole.scene import Reconstruction
from epipole.scene.georeference import gps_to_enu

MAX_TRIPLES = 2000
"""Maximum number of samples in the robust alignment."""
MIN_STEP_M = 3.0
"""Fixes in steps of 0.1 arc seconds are on a grid of about three meters; smaller steps have no direction."""


def score_gps(task: SfmTask, model: Reconstruction) -> dict[str, float]:
    """Median distance to the fixes after a robust similarity, and median angle between optical axis and motion.

    The motion is the horizontal direction from an image's fix to that of the next image.
    """
    enu = _fixes(task)
    registered = np.flatnonzero(model.is_registered())
    row_of = {model.images.name[i]: i for i in registered}
    with_fix = [k for k, name in enumerate(task.image_names) if name in row_of and np.isfinite(enu[k]).all()]
    rows = [row_of[task.image_names[k]] for k in with_fix]
    centers = model.camera_centers_in_world()[rows]
    enu_from_world = align_robustly(centers, enu[with_fix])
    if enu_from_world is None:
        return {}
    residuals = np.linalg.norm(enu_from_world.apply(centers) - enu[with_fix], axis=1)
    score = {"gps_median_m": float(np.median(residuals))}
    axes = (enu_from_world.rotation @ model.cams_from_world().rotation[rows].transpose(0, 2, 1))[:, :, 2]
    steps = np.full((len(enu), 2), np.nan)
    steps[:-1] = enu[1:, :2] - enu[:-1, :2]
    directions = steps[with_fix]
    moving = np.linalg.norm(directions, axis=1) >= MIN_STEP_M
    if moving.any():
        a, b = axes[moving, :2], directions[moving]
        angles = np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))
        score["axis_to_motion_median_deg"] = float(np.degrees(np.median(np.abs(angles))))
    return score


def align_robustly(source: np.ndarray, target: np.ndarray) -> Similarity3 | None:
    """target_from_source with the least median distance over samples of three points, refined on its inliers.

    None for fewer than three points or points on a line (Rousseeuw, Least Median of Squares, JASA 1984).
    """
    triples = np.array(list(combinations(range(len(source)), 3))).reshape(-1, 3)
    if len(triples) > MAX_TRIPLES:
        triples = triples[np.random.default_rng(0).choice(len(triples), MAX_TRIPLES, replace=False)]
    best, best_median = None, np.inf
    for triple in triples:
        candidate = _align(source[triple], target[triple])
        if candidate is None:
            continue
        median = float(np.median(np.linalg.norm(candidate.apply(source) - target, axis=1)))
        if median < best_median:
            best, best_median = candidate, median
    for _ in range(3):
        if best is None:
            return None
        distances = np.linalg.norm(best.apply(source) - target, axis=1)
        inliers = distances <= max(2.5 * np.median(distances), 1e-12)
        best = _align(source[inliers], target[inliers]) or best
    return best


def _align(source: np.ndarray, target: np.ndarray) -> Similarity3 | None:
    try:
        return align_points(source, target)
    except DegenerateGeometryError:
        return None


def _fixes(task: SfmTask) -> np.ndarray:
    """East, north and up of every image in meters; NaN if it has no fix."""
    table = np.full((len(task.image_names), 3), np.nan)
    for k, name in enumerate(task.image_names):
        fix = read_header(task.images / name).gps
        if fix is not None:
            table[k] = fix.lat_deg, fix.lon_deg, np.nan if fix.alt_m is None else fix.alt_m
    return gps_to_enu(table)
