"""Scores of a COLMAP model, computed in the same way for every program."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.gps import score_gps
from benchmarks.tasks.sfm import SfmTask
from epipole.errors import DegenerateGeometryError, EpipoleError
from epipole.geometry import Rigid3
from epipole.io.colmap.model import read_colmap_model
from epipole.io.truth import read_truth
from epipole.metrics import camera_errors, relative_pose_auc
from epipole.scene import Reconstruction

MAX_REPROJECTION_PX = 4.0
MIN_TRACK_LENGTH = 2
AUC_THRESHOLDS_DEG = (0.5, 1.0, 3.0, 5.0, 10.0)

Score = dict[str, float]


def score_models(task: SfmTask, sparse: Path) -> Score:
    """Score the largest model under `sparse`; metrics that do not apply to the task are missing."""
    model, num_unreadable = largest_model(sparse)
    score: Score = {"pictures": len(task.image_names), "registered": 0, "points": 0, "observations": 0}
    if model is not None:
        score["registered"] = int(model.is_registered().sum())
        score |= count_under_filter(model)
    if num_unreadable:
        score["unreadable_models"] = num_unreadable
    if task.truth is not None:
        score |= _score_truth(task, model)
    if task.has_gps and model is not None:
        score |= score_gps(task, model)
    return score


def largest_model(sparse: Path) -> tuple[Reconstruction | None, int]:
    """The model under `sparse` with the most registered images, then points; None if there is none.

    The second value is the number of models excluded as invalid (for example with a negative focal length).
    """
    folders = [p.parent for p in sorted(sparse.glob("*/images.*")) if p.suffix in (".bin", ".txt")]
    models, num_unreadable = [], 0
    for folder in dict.fromkeys(folders):
        try:
            models.append(read_colmap_model(folder))
        except EpipoleError:
            num_unreadable += 1
    best = max(models, key=lambda m: (int(m.is_registered().sum()), len(m.points)), default=None)
    return best, num_unreadable


def count_under_filter(model: Reconstruction) -> Score:
    """Points and observations with a reprojection error of at most 4 px, in tracks of at least two images."""
    is_inlier = model.reprojection_errors_px() <= MAX_REPROJECTION_PX
    point, image = model.tracks.point_of_observation()[is_inlier], model.tracks.image[is_inlier]
    seen = np.unique(np.stack([point, image]), axis=1)[0]
    lengths = np.bincount(seen, minlength=len(model.points))
    is_long = lengths >= MIN_TRACK_LENGTH
    return {"points": int(is_long.sum()), "observations": int(lengths[is_long].sum())}


def _score_truth(task: SfmTask, model: Reconstruction | None) -> Score:
    """Errors after the best similarity, and areas under the recall curve over all image pairs with ground truth."""
    auc_names = [f"auc_{threshold:g}" for threshold in AUC_THRESHOLDS_DEG]
    if model is None or task.truth is None:
        return dict.fromkeys(auc_names, 0.0)
    truth = read_truth(task.truth)
    names = {*task.image_names}
    # Published models may have more images than the set.
    given = [row for row, name in enumerate(truth.names) if name in names]
    true = truth.cams_from_world[given]
    estimated = cams_in_order(model, tuple(truth.names[row] for row in given))
    registered = np.isfinite(estimated.translation).all(axis=1)
    auc = relative_pose_auc(estimated, true, registered, AUC_THRESHOLDS_DEG)
    score = dict(zip(auc_names, auc.tolist()))
    try:
        errors = camera_errors(estimated, true)
    except DegenerateGeometryError:
        return score
    score["position_mean"], score["position_median"] = errors.mean_position, errors.median_position
    score["position_max"], score["rotation_mean_deg"] = errors.max_position, errors.mean_rotation_deg
    return score


def cams_in_order(model: Reconstruction, names: tuple[str, ...]) -> Rigid3:
    """cams_from_world of the named images; NaN if the model does not have one."""
    cams_from_world = model.cams_from_world()
    row_of = {name: row for row, name in enumerate(model.images.name)}
    rotation, translation = np.full((len(names), 3, 3), np.nan), np.full((len(names), 3), np.nan)
    for k, name in enumerate(names):
        if name in row_of:
            rotation[k] = cams_from_world.rotation[row_of[name]]
            translation[k] = cams_from_world.translation[row_of[name]]
    return Rigid3(rotation, translation)
