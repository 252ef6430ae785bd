"""`epipole evaluate`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from epipole.pipelines.evaluation.run import Evaluation
    from epipole.pipelines.evaluation.trajectories import TrajectoryEvaluation


def evaluate(
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")], truth: Path, json: bool = False
) -> None:
    """Compare a model's cameras, or a trajectory, with known ones.

    Args:
        out: Output folder, a COLMAP model, or a trajectory (TUM, KITTI or EuRoC).
        truth: COLMAP model, folder of Strecha .camera files, Middlebury _par.txt file, or a trajectory.
        json: Print JSON.
    """
    from epipole.io.json_files import json_text
    from epipole.pipelines.evaluation.trajectories import evaluate_trajectory, trajectories_of

    if paths := trajectories_of(out, truth):
        found = {path.name: evaluate_trajectory(path, truth) for path in paths}
        if json:
            print(json_text({name: asdict(result) for name, result in found.items()}), end="")
        else:
            for name, result in found.items():
                show_trajectory_evaluation(name, result)
        return
    from epipole.pipelines.evaluation.run import evaluate as run

    cameras = run(out, truth)
    if json:
        print(json_text(asdict(cameras)), end="")
    else:
        show_evaluation(cameras)


def show_trajectory_evaluation(name: str, result: TrajectoryEvaluation) -> None:
    """Print errors against a known trajectory."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"{name}: {result.num_compared} of {result.num_instants} instants compared", box=None)
    for column in ("aligned", "ATE rmse", "median", "max", "rotation rmse, degrees", "scale"):
        table.add_column(column)
    for kind, score in (("rigidly", result.rigid), ("with scale", result.similarity)):
        numbers = (score.ate_rmse, score.ate_median, score.ate_max, score.rotation_rmse_deg, score.scale)
        table.add_row(kind, *(f"{number:.6g}" for number in numbers))
    console = Console()
    console.print(table)
    lines = [
        f"path {result.path_length:.6g} (truth's unit, as all lengths)",
        f"from one instant to the next: {result.step_rmse:.6g}, {result.step_rotation_rmse_deg:.6g} degrees (rmse)",
    ]
    if result.kitti_percent is not None:
        lines.append(
            f"KITTI: t_rel {result.kitti_percent:.4g} %, r_rel {result.kitti_deg_per_100m:.4g} degrees / 100 m"
        )
    console.print("\n".join(lines), highlight=False)


def show_evaluation(result: Evaluation) -> None:
    """Print errors against known cameras."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, show_header=False)
    table.add_row("registered", f"{result.num_registered} of {result.num_truth}")
    table.add_row(
        "position error",
        f"mean {result.position_mean:.6g}, median {result.position_median:.6g}, max {result.position_max:.6g} (truth's unit)",
    )
    table.add_row(
        "rotation error", f"mean {result.rotation_mean_deg:.4f}, max {result.rotation_max_deg:.4f} degrees"
    )
    table.add_row("AUC of relative pose", ", ".join(f"@{d}: {100 * a:.2f}" for d, a in result.auc.items()))
    Console().print(table)
