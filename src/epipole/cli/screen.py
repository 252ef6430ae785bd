"""What the commands draw: progress with the time left, and short tables."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars
from rich.table import Table

if TYPE_CHECKING:
    from epipole.api import Evaluation, ReconstructionResult
    from epipole.workflow import Progress, ProgressCallback

WORDS = {
    "video": "Taking frames",
    "read": "Reading headers",
    "features": "Finding features",
    "compile": "Compiling kernels",
    "match": "Matching pairs",
    "verify": "Verifying pairs",
    "map": "Placing images",
    "undistort": "Undistorting",
    "render": "Rendering photographs",
}
COMPILE_NOTE = "Compiling kernels, once on this machine (about a minute; later runs start at once)"


@contextmanager
def progress_on_screen() -> Iterator[ProgressCallback]:
    """A progress callback that draws one bar per stage, with the time left."""
    columns = (
        *(TextColumn("{task.description:<22}"), BarColumn(bar_width=32), MofNCompleteColumn()),
        *(TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn()),
    )
    with Bars(*columns, console=Console(stderr=True)) as bars:
        tasks: dict[str, TaskID] = {}
        from epipole import _jit

        if not _jit.is_compiled():
            bars.console.print(COMPILE_NOTE)

        def show(report: Progress) -> None:
            if report.stage not in tasks:
                tasks[report.stage] = bars.add_task(WORDS.get(report.stage, report.stage), total=report.total)
            bars.update(tasks[report.stage], completed=report.done, total=report.total)

        yield show


def show_reconstruction(result: ReconstructionResult) -> None:
    """Print what was made and where it is."""
    console, model, summary = Console(), result.model, result.summary
    table = Table(box=None, show_header=False)
    table.add_row("images placed", f"{summary['num_registered']} of {summary['num_images']}")
    table.add_row("points", f"{len(model.points):,} ({len(model.tracks.image):,} observations)")
    table.add_row("reprojection error", f"{summary['mean_reprojection_error_px']:.2f} px")
    scale = "metres, from GPS" if summary["is_metric"] else "unknown: pictures alone cannot tell"
    table.add_row("scale", scale)
    times = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in result.timings_s.items())
    table.add_row("time", f"{summary['seconds']:.1f} s ({times})")
    if summary["compile_seconds"] > 1:
        table.add_row(
            "", f"of which compiling kernels, once on this machine: {summary['compile_seconds']:.0f} s"
        )
    console.print(table)
    for warning in result.warnings:
        console.print(f"note: {warning}", style="yellow", highlight=False, markup=False)
    for name, reason in list(result.reasons.items())[:10]:
        console.print(f"  {name}: {reason}", highlight=False, markup=False)
    console.print(
        f"model   {result.out / 'sparse' / '0'}\nreport  {result.out / 'report.html'}",
        highlight=False,
        markup=False,
    )
    console.print(f"look    epipole view {result.out}", highlight=False, markup=False)


def show_evaluation(result: Evaluation) -> None:
    """Print errors against known cameras."""
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
