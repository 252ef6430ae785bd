"""`epipole evaluate`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from epipole._terminal import say

if TYPE_CHECKING:
    from epipole.pipelines.evaluation.run import Evaluation
    from epipole.pipelines.evaluation.trajectories import TrajectoryEvaluation


def evaluate(
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    truth: Path,
    max_difference_s: float = 0.01,
    json: bool = False,
) -> None:
    """Compare camera poses or a trajectory with the truth.

    Args:
        out: Output folder, a COLMAP model or cameras of another program, or a trajectory (TUM, KITTI or EuRoC).
        truth: Output folder, COLMAP model, transforms.json or cameras of another program, folder of Strecha .camera files,
            Middlebury _par.txt file, trajectory, or dataset folder (7-Scenes, ScanNet, TUM RGB-D, KITTI, EuRoC).
        max_difference_s: Trajectories: largest time difference between compared poses.
        json: Print JSON.
    """
    from epipole.io.json_files import json_text
    from epipole.pipelines.evaluation.trajectories import evaluate_trajectory, trajectories_of
    from epipole.screen import working

    if paths := trajectories_of(out, truth):
        with working():
            found = {path.name: evaluate_trajectory(path, truth, max_difference_s) for path in paths}
        if json:
            print(json_text({name: asdict(result) for name, result in found.items()}), end="")
        else:
            for name, result in found.items():
                show_trajectory_evaluation(name, result)
            say("Lengths are in the ground truth's unit.")
        return
    from epipole.pipelines.evaluation.run import evaluate as run

    with working():
        cameras = run(out, truth)
    if json:
        print(json_text(asdict(cameras)), end="")
    else:
        show_evaluation(cameras)


def show_trajectory_evaluation(name: str, result: TrajectoryEvaluation) -> None:
    """Print a trajectory's errors."""
    from rich.table import Table

    from epipole.screen import open_console

    console = open_console()
    console.print(
        f"{name}: {result.num_compared} of {result.num_instants} poses compared with {result.num_truth} of"
        f" the ground truth, over a trajectory of length {result.path_length:.4g}",
        highlight=False,
        markup=False,
    )
    for words in result.assumptions:
        console.print(f"  {words}", highlight=False, markup=False)
    if 2 * result.num_compared < min(result.num_instants, result.num_truth):
        console.print(
            "  Most poses have no counterpart: check that clocks and time units are the same.",
            highlight=False,
        )
    table = Table(box=None, pad_edge=True)
    for column in ("aligned", "ATE rmse", "median", "max", "scale", "RPE rmse", "KITTI t_rel"):
        table.add_column(column, justify="left" if column == "aligned" else "right")
    for kind, score in (("SE(3), scale fixed", result.rigid), ("Sim(3), scale aligned", result.similarity)):
        numbers = (score.ate_rmse, score.ate_median, score.ate_max, score.scale, score.step_rmse)
        t_rel = "length < 100" if score.kitti_percent is None else f"{score.kitti_percent:.3f} %"
        table.add_row(kind, *(f"{number:.4g}" for number in numbers), t_rel)
    console.print(table)
    rotated = (
        f"rotation: {result.rigid.rotation_rmse_deg:.3g} degrees (rmse, after alignment of positions, which"
        f" hardly constrains the rotation about a straight or stationary trajectory),"
        f" {result.step_rotation_rmse_deg:.3g} degrees from one pose to the next"
    )
    if result.kitti_deg_per_100m is not None:
        rotated += f", KITTI r_rel {result.kitti_deg_per_100m:.4g} degrees / 100 m"
    console.print(f" {rotated}", highlight=False)


def show_evaluation(result: Evaluation) -> None:
    """Print a model's camera errors."""
    from rich.table import Table

    from epipole.screen import open_console

    table = Table(box=None, show_header=False)
    table.add_row("registered", f"{result.num_registered} of {result.num_truth}")
    table.add_row(
        "position error",
        f"mean {result.position_mean:.6g}, median {result.position_median:.6g}, max {result.position_max:.6g}, "
        f"rmse {result.position_rmse:.6g} (ground truth's unit)",
    )
    table.add_row(
        "with scale fixed", f"rmse {result.position_rmse_same_scale:.6g}, if both are in the same unit"
    )
    table.add_row("scale", f"{result.scale:.6g} of the ground truth's units per unit of the model")
    table.add_row(
        "rotation error", f"mean {result.rotation_mean_deg:.4f}, max {result.rotation_max_deg:.4f} degrees"
    )
    table.add_row("AUC of relative pose", ", ".join(f"@{d}: {100 * a:.2f}" for d, a in result.auc.items()))
    open_console().print(table)
