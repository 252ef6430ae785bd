"""Errors of a SLAM trajectory against ground truth, computed in the same way for every program."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from epipole.errors import EpipoleError
from epipole.geometry import Rigid3, Rotation3
from epipole.io.trajectories.files import read_trajectory
from epipole.metrics import absolute_error, associate
from epipole.scene import Trajectory

PURE_ROTATION_M = 1e-6
"""Motion with a smaller extent counts as pure rotation."""


def score_run(out: Path, frames: Path, truths: dict[str, Path]) -> dict[str, Any]:
    """Figures of one run, from the files of `save_answers` and the program's final trajectory."""
    answers = np.load(out / "causal.npz")
    times, ms = np.load(frames / "times.npy"), answers["ms"]
    causal = _localized(times[: len(ms)], answers["world_from_camera"])
    score: dict[str, Any] = {
        "frames": len(times),
        "ms_median": float(np.median(ms)),
        "ms_p95": float(np.percentile(ms, 95)),
        "segments": _num_segments(answers["world_from_camera"]),
    }
    for when, poses in (("causal", causal), ("final", _final(out))):
        score[when] = {"coverage": 0.0 if poses is None else len(poses) / len(times)}
        if poses is not None:
            score[when] |= {name: score_path(poses, read_trajectory(file)) for name, file in truths.items()}
    return score


def score_path(path: Trajectory, truth: Trajectory) -> dict[str, Any]:
    """Root mean square errors after rigid and similarity alignment; for pure rotation, the false motion."""
    try:
        rows, of_truth = associate(path, truth)
    except EpipoleError as error:
        return {"error": str(error)}
    estimate, true = path.world_from_body[rows], truth.world_from_body[of_truth]
    score: dict[str, Any] = {"compared": len(rows)}
    if np.linalg.norm(true.translation - true.translation[0], axis=1).max() < PURE_ROTATION_M:
        return score | _false_motion(estimate, true)
    for name, alignment in (("se3", "rigid"), ("sim3", "similarity")):
        try:
            error = absolute_error(estimate, true, alignment)
        except EpipoleError as problem:
            score[f"{name}_error"] = str(problem)
            continue
        score[f"{name}_m"] = error.position.rmse
        score[f"{name}_rotation_deg"] = error.rotation_deg.rmse
        score[f"{name}_scale"] = float(error.truth_from_estimate.scale)
    return score


def _false_motion(estimate: Rigid3, true: Rigid3) -> dict[str, float]:
    """Distance from the first pose, which should be zero, and error of the rotation since then."""
    first_from_pose = estimate[0].inverse() @ estimate
    true_rotation = Rotation3(true[0].rotation).inverse() @ Rotation3(true.rotation)
    error = true_rotation.inverse() @ Rotation3(first_from_pose.rotation)
    distance, angle = np.linalg.norm(first_from_pose.translation, axis=1), np.degrees(error.angle_rad())
    return {
        "made_up_rms": float(np.sqrt(np.mean(distance**2))),
        "made_up_max": float(distance.max()),
        "turn_rms_deg": float(np.sqrt(np.mean(angle**2))),
        "turn_max_deg": float(angle.max()),
    }


def _localized(times: np.ndarray, poses: np.ndarray) -> Trajectory | None:
    """The frames with a pose; None if there are none."""
    known = np.isfinite(poses).all(axis=(1, 2))
    if not known.any():
        return None
    rotation = Rotation3.nearest(poses[known, :3, :3]).matrix
    return Trajectory(times[known], Rigid3(rotation, poses[known, :3, 3].copy()))


def _final(out: Path) -> Trajectory | None:
    for name in ("final.txt", "final.csv"):
        file = out / name
        if not file.is_file():
            continue
        try:
            return read_trajectory(file) if name == "final.txt" else read_trajectory(file, "euroc")
        except EpipoleError:
            return None
    return None


def _num_segments(poses: np.ndarray) -> int:
    """Number of sections of consecutive frames with a pose."""
    known = np.isfinite(poses).all(axis=(1, 2))
    return int(known[0]) + int((~known[:-1] & known[1:]).sum()) if len(known) else 0
