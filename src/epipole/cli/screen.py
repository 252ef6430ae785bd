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
    from epipole.stereo.pipeline import StereoResult
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


@contextmanager
def waiting_for_kernels() -> Iterator[None]:
    """A line that moves while a short command works, with the reason where it has to compile first."""
    console = Console(stderr=True)
    from epipole import _jit

    begin = _jit.compile_seconds()
    with console.status("Working (the first time on a machine kernels are compiled, for some seconds)"):
        yield
    if (seconds := _jit.compile_seconds() - begin) > 1.0:
        console.print(f"{seconds:.0f} s of this went into compiling kernels; later runs start at once")


def show_stereo(result: StereoResult) -> None:
    """What of the pair is known, and where it lies."""
    import numpy as np

    from epipole.stereo import StereoReason

    found = result.disparities
    known = np.isfinite(found.disparity_px)
    table = Table(title=f"Stereo pair: {100 * found.density:.1f} % of the pixels known", show_header=False)
    for reason in StereoReason:
        share = float((found.reason == reason).mean())
        if share > 0 and reason != StereoReason.OK:
            table.add_row(reason.name.lower().replace("_", " "), f"{100 * share:.1f} %")
    if known.any():
        low, high = np.percentile(found.disparity_px[known], (1, 99))
        table.add_row("disparities", f"{low:.1f} to {high:.1f} px")
        table.add_row("their median standard deviation", f"{np.median(found.sigma_px[known]):.2f} px")
    if result.depths is not None and np.isfinite(result.depths.depth).any():
        near, far = np.nanpercentile(result.depths.depth, (1, 99))
        table.add_row("depths", f"{near:.3g} to {far:.3g}")
        table.add_row("points", f"{result.num_points}")
    table.add_row("written to", str(result.out))
    Console().print(table)
