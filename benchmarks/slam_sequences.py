"""epipole's SLAM on real sequences: errors, and coverage of the covariances. `python -m benchmarks.slam_sequences`.

The default calibration errors in the covariances were chosen on hololens, kitchen and kitti06.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.stats import chi2

import epipole
from benchmarks.measure import REPOSITORY, describe_machine
from epipole.geometry import Rotation3, align_points
from epipole.io.trajectories.true_trajectories import true_path_at
from epipole.metrics import absolute_error, associate
from epipole.scene import Trajectory

RESULTS = REPOSITORY / "benchmarks" / "results" / "slam_sequences.json"
MAX_TIME_DIFFERENCE_S = 0.03
"""Largest time between a frame and its ground truth."""
GROSS_ERROR_DEG = 3.0
"""Rotation errors between neighboring frames above this are gross errors, not noise."""


@dataclass(frozen=True)
class Sequence:
    """A folder of frames with its ground truth and options for SLAM."""

    folder: str
    truth: str
    options: dict[str, Any] = field(default_factory=dict)
    truth_hz: float = 1.0
    """Frame rate, if the ground truth has frame numbers instead of times."""


HOLOLENS: dict[str, Any] = {
    "camera_model": "PINHOLE",
    "camera_params": "495.5678,495.4820,270.0029,169.6941",
}
SEQUENCES = {
    "hololens": Sequence("hololens", "groundtruth.txt", HOLOLENS),
    "hololens-mono": Sequence("hololens", "groundtruth.txt", {**HOLOLENS, "sensor": "mono"}),
    "kitchen": Sequence("7scenes", "poses_sfm.txt", truth_hz=30.0),
    "kitchen-mono": Sequence("7scenes", "poses_sfm.txt", {"sensor": "mono"}, truth_hz=30.0),
    "kitti06": Sequence("kitti06_stereo", "poses.txt"),
    "kitti06-mono": Sequence("kitti06_stereo", "poses.txt", {"sensor": "mono"}),
    "kitti00-mono": Sequence("kitti00_mono", "poses.txt", {"sensor": "mono"}),
}


def measured(sequence: Sequence, data: Path, out: Path) -> dict[str, Any]:
    """Figures of one run; position errors are after rigid alignment, for one camera after a similarity."""
    start = time.perf_counter()
    folder = data / "slam" / sequence.folder
    result = epipole.slam(folder, out, **sequence.options)
    estimate, truth = result.trajectory, true_path_at(folder / sequence.truth).trajectory
    figures: dict[str, Any] = {
        "frames": result.summary["num_frames"],
        "with_pose": len(estimate),
        "seconds": time.perf_counter() - start,
        "warnings": list(result.warnings),
    }
    if truth.is_timed:
        truth = Trajectory(truth.timestamp_s / sequence.truth_hz, truth.world_from_body)
    rows, of_truth = associate(estimate, truth, MAX_TIME_DIFFERENCE_S)
    ours, true = estimate.world_from_body[rows], truth.world_from_body[of_truth]
    is_metric = sequence.options.get("sensor") != "mono"
    figures["position_rms_m"] = absolute_error(
        ours, true, "rigid" if is_metric else "similarity"
    ).position.rmse
    motion_error = (ours[:-1].inverse() @ ours[1:]).inverse() @ (true[:-1].inverse() @ true[1:])
    rotation_error_deg = np.degrees(Rotation3(motion_error.rotation).angle_rad())
    figures["largest_turn_error_deg"] = float(rotation_error_deg.max())
    figures["refuted_turns"] = int((rotation_error_deg > GROSS_ERROR_DEG).sum())
    if is_metric and estimate.covariance is not None:
        figures["coverage"] = coverage(ours, true, estimate.covariance[rows])
    return figures


def coverage(ours: epipole.Rigid3, true: epipole.Rigid3, covariance: np.ndarray) -> dict[str, float]:
    """Fractions of the position errors within the 68.3 % and 95.4 % regions, after rigid alignment with the truth."""
    ours_from_true = align_points(true.translation, ours.translation, with_scale=False)
    error = ours.translation - ours_from_true.apply(true.translation)
    in_body = np.einsum("nji,nj->ni", ours.rotation, error)[1:]
    squared = np.einsum(
        "ni,ni->n", in_body, np.linalg.solve(covariance[1:, :3, :3], in_body[..., None])[..., 0]
    )
    return {f"{p:.1f}": float((squared < chi2.ppf(p / 100, 3)).mean()) for p in (68.3, 95.4)}


def main() -> None:
    """Run the sequences and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--set", nargs="+", choices=list(SEQUENCES), default=list(SEQUENCES))
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    arguments = parser.parse_args()
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    report: dict[str, Any] = {"machine": describe_machine(2), "sets": {}}
    table = Table(title="SLAM on real sequences")
    for column in (
        "set",
        "poses",
        "position RMS",
        "largest rotation error",
        f"> {GROSS_ERROR_DEG:g} deg",
        "within 68.3 / 95.4 %",
        "time",
    ):
        table.add_column(column, justify="right")
    for name in arguments.set:
        with tempfile.TemporaryDirectory() as folder:
            row = report["sets"][name] = measured(SEQUENCES[name], data, Path(folder) / "out")
        within = " / ".join(f"{100 * fraction:.0f}" for fraction in row.get("coverage", {}).values())
        table.add_row(
            *(name, f"{row['with_pose']} of {row['frames']}", f"{100 * row['position_rms_m']:.2f} cm"),
            *(
                f"{row['largest_turn_error_deg']:.2f} deg",
                str(row["refuted_turns"]),
                within,
                f"{row['seconds']:.0f} s",
            ),
        )
    Console(width=120).print(table)
    if arguments.set == list(SEQUENCES):
        RESULTS.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
