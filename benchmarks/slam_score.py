"""What a path is worth against the truth; the same code for every program."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from epipole.errors import EpipoleError
from epipole.geometry import Rigid3, Rotation3
from epipole.io.trajectories.files import read_trajectory
from epipole.metrics import absolute_error, associate
from epipole.scene import Trajectory

STANDS_M = 1e-6
"""A true path that reaches no farther is a turn on the spot."""


def score_run(out: Path, frames: Path, truths: dict[str, Path]) -> dict[str, Any]:
    """Figures of one run, of what `save_answers` and the program itself left in a folder."""
    answers = np.load(out / "causal.npz")
    times, ms = np.load(frames / "times.npy"), answers["ms"]
    causal = _localized(times[: len(ms)], answers["world_from_camera"])
    score: dict[str, Any] = {
        "frames": len(times),
        "ms_median": float(np.median(ms)),
        "ms_p95": float(np.percentile(ms, 95)),
        "segments": _num_segments(answers["world_from_camera"]),
    }
    for when, path in (("causal", causal), ("final", _final(out))):
        score[when] = {"coverage": 0.0 if path is None else len(path) / len(times)}
        if path is not None:
            score[when] |= {name: score_path(path, read_trajectory(file)) for name, file in truths.items()}
    return score


def score_path(path: Trajectory, truth: Trajectory) -> dict[str, Any]:
    """Root mean squares after both alignments; of a turn on the spot, the motion that was made up."""
    try:
        rows, of_truth = associate(path, truth)
    except EpipoleError as error:
        return {"error": str(error)}
    estimate, true = path.world_from_body[rows], truth.world_from_body[of_truth]
    score: dict[str, Any] = {"compared": len(rows)}
    if np.linalg.norm(true.translation - true.translation[0], axis=1).max() < STANDS_M:
        return score | _made_up(estimate, true)
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


def _made_up(estimate: Rigid3, true: Rigid3) -> dict[str, float]:
    """Distance and turn of each place from the first one, against the truth: nothing, and the true turn."""
    from_first = estimate[0].inverse() @ estimate
    true_turn = Rotation3(true[0].rotation).inverse() @ Rotation3(true.rotation)
    rotation = true_turn.inverse() @ Rotation3(from_first.rotation)
    distance, angle = np.linalg.norm(from_first.translation, axis=1), np.degrees(rotation.angle_rad())
    return {
        "made_up_rms": float(np.sqrt(np.mean(distance**2))),
        "made_up_max": float(distance.max()),
        "turn_rms_deg": float(np.sqrt(np.mean(angle**2))),
        "turn_max_deg": float(angle.max()),
    }


def _localized(times: np.ndarray, positions: np.ndarray) -> Trajectory | None:
    known = np.isfinite(positions).all(axis=(1, 2))
    if not known.any():
        return None
    rotation = Rotation3.nearest(positions[known, :3, :3]).matrix
    return Trajectory(times[known], Rigid3(rotation, positions[known, :3, 3].copy()))


def _final(out: Path) -> Trajectory | None:
    for name in ("final.txt", "final.csv"):
        file = out / name
        if not file.is_file():
            continue
        try:
            return read_trajectory(file) if name == "final.txt" else _euroc(file)
        except EpipoleError:
            return None
    return None


def _euroc(file: Path) -> Trajectory:
    """EuRoC's columns, nanoseconds first; some programs put blanks and no header where the set has commas."""
    return read_trajectory(file, "euroc")


def _num_segments(positions: np.ndarray) -> int:
    """Runs of frames with a place, one after the other."""
    known = np.isfinite(positions).all(axis=(1, 2))
    return int(known[0]) + int((~known[:-1] & known[1:]).sum()) if len(known) else 0
