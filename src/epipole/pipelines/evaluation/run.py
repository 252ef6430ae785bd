"""Evaluation of a model's cameras against ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole._checks import as_path, checked
from epipole.errors import DegenerateGeometryError, FileFormatError
from epipole.geometry import Rigid3, Similarity3
from epipole.io.convert import is_model_file, read_model
from epipole.io.truth import read_truth
from epipole.metrics import camera_errors, relative_pose_auc

THRESHOLDS_DEG = (0.5, 1, 3, 5, 10)
"""Limits of the recall curves, among them those of COLMAP's benchmarks."""
TRAJECTORY_SUFFIXES = (".txt", ".csv", ".tum", ".kitti")


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Errors of a model's cameras."""

    num_truth: int
    num_registered: int
    """Number of ground-truth cameras that are registered."""
    position_mean: float
    """After the best similarity transform, in the ground truth's unit."""
    position_median: float
    position_max: float
    position_rmse: float
    """ATE: root mean square of the position errors."""
    position_rmse_same_scale: float
    """The same after the best rotation and translation only, for models in the ground truth's unit."""
    rotation_mean_deg: float
    rotation_max_deg: float
    scale: float
    """Ground truth's units per unit of the model; if both are meters, its difference from 1 is the scale error."""
    auc: dict[float, float]
    """Area under the recall curve of relative pose errors over all pairs, up to 0.5, 1, 3, 5 and 10 degrees."""

    def __repr__(self) -> str:
        return (
            f"Evaluation({self.num_registered} of {self.num_truth} cameras, position mean {self.position_mean:.4g}, "
            f"rotation mean {self.rotation_mean_deg:.4g} deg)"
        )


@checked
def evaluate(out: str | Path, truth: str | Path) -> Evaluation:
    """Compare a model's cameras with ground truth; for trajectories use `evaluate_trajectory`.

    Args:
        out: an output folder, a COLMAP model, a transforms.json, or the cameras of another program (see `read_model`).
        truth: any of these, a folder of Strecha `.camera` files, or a Middlebury `_par.txt` file.

    Raises:
        FileFormatError: a path is unreadable or a trajectory, or the two have no images in common.
        DegenerateGeometryError: fewer than two ground-truth cameras are registered.
    """
    for path in (as_path(out), as_path(truth)):
        if (
            path.suffix.lower() in TRAJECTORY_SUFFIXES
            and path.is_file()
            and not path.name.endswith("_par.txt")
            and not is_model_file(path)
        ):
            raise FileFormatError(
                path, "not a model: compare trajectories with evaluate_trajectory(path, truth)"
            )
    model, known = read_model(as_path(out)), read_truth(as_path(truth))
    row = {name: i for i, name in enumerate(model.images.name)}
    cams_from_world, is_registered = model.cams_from_world(), model.is_registered()
    rotation, translation = np.full((len(known.names), 3, 3), np.nan), np.full((len(known.names), 3), np.nan)
    for n, name in enumerate(known.names):
        if name in row and is_registered[row[name]]:
            rotation[n] = cams_from_world.rotation[row[name]]
            translation[n] = cams_from_world.translation[row[name]]
    found = np.isfinite(translation).all(axis=1)
    if not found.any():
        raise FileFormatError(
            Path(truth), "none of its images is registered in the model: check that the names agree"
        )
    if found.sum() < 2:
        raise DegenerateGeometryError("only one known camera is registered; errors need at least two")
    estimated = Rigid3(rotation, translation)
    errors = camera_errors(estimated, known.cams_from_world)
    auc = relative_pose_auc(estimated, known.cams_from_world, found, THRESHOLDS_DEG)
    return Evaluation(
        len(known.names),
        int(found.sum()),
        errors.mean_position,
        errors.median_position,
        errors.max_position,
        float(np.sqrt(np.nanmean(errors.position**2))),
        _rmse_same_scale(
            estimated[found], known.cams_from_world[found], errors.alignment.truth_from_estimated
        ),
        errors.mean_rotation_deg,
        errors.max_rotation_deg,
        float(errors.alignment.truth_from_estimated.scale),
        {degrees: float(value) for degrees, value in zip(THRESHOLDS_DEG, auc)},
    )


def _rmse_same_scale(estimated: Rigid3, truth: Rigid3, truth_from_estimated: Similarity3) -> float:
    """RMSE of the positions after the best rotation and translation; the rotation is that of the best similarity (Umeyama 1991)."""
    rotated, true = estimated.centers() @ truth_from_estimated.rotation.T, truth.centers()
    off = (rotated - rotated.mean(axis=0)) - (true - true.mean(axis=0))
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
