"""`epipole evaluate`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from epipole.pipelines.evaluation.run import Evaluation


def evaluate(
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")], truth: Path, json: bool = False
) -> None:
    """Compare a model's cameras with known ones.

    Args:
        out: Output folder of a reconstruction, or a COLMAP model.
        truth: COLMAP model, folder of Strecha .camera files, or Middlebury _par.txt file.
        json: Print JSON.
    """
    from epipole.pipelines.evaluation.run import evaluate as run

    result = run(out, truth)
    if json:
        from epipole.io.json_files import json_text

        print(json_text(asdict(result)), end="")
    else:
        show_evaluation(result)


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
