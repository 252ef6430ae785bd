"""What the commands draw: progress with the time left, and short tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
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
    from epipole.calibration.pipeline import CalibrationRun
    from epipole.stereo.batch import StereoBatch
    from epipole.stereo.doctor import Diagnosis
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
    "board": "Looking for the board",
    "calibrate": "Calibrating",
    "pairs": "Measuring pairs",
}
COMPILE_NOTE = "Compiling kernels, once on this machine (about a minute; later runs start at once)"


@contextmanager
def progress_on_screen(*, compiles_much: bool = False) -> Iterator[ProgressCallback]:
    """A progress callback that draws one bar per stage, with the time left; what compiles for a minute says so."""
    columns = (
        *(TextColumn("{task.description:<22}"), BarColumn(bar_width=32), MofNCompleteColumn()),
        *(TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn()),
    )
    from epipole import _jit

    console, begin = Console(stderr=True), _jit.compile_seconds()
    with Bars(*columns, console=console) as bars:
        tasks: dict[str, TaskID] = {}

        if compiles_much and not _jit.is_compiled():
            bars.console.print(COMPILE_NOTE)

        def show(report: Progress) -> None:
            if report.stage not in tasks:
                tasks[report.stage] = bars.add_task(WORDS.get(report.stage, report.stage), total=report.total)
            bars.update(tasks[report.stage], completed=report.done, total=report.total)

        yield show
    if not compiles_much:
        _say_compiling(console, _jit.compile_seconds() - begin)


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
    _print_warnings(console, result.warnings)
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
    _say_compiling(console, _jit.compile_seconds() - begin)


def _say_compiling(console: Console, seconds: float) -> None:
    if seconds > 1.0:
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
    console = Console()
    console.print(table)
    _print_warnings(console, result.warnings)


def show_batch(batch: StereoBatch) -> None:
    """How many pairs were measured, and why others were not."""
    console = Console()
    earlier = f", {len(batch.earlier)} by an earlier run" if batch.earlier else ""
    console.print(f"{len(batch.done)} pairs measured{earlier}; in {batch.out}", highlight=False)
    if batch.known:
        shares = sorted(batch.known.values())
        console.print(f"known pixels: {100 * shares[0]:.0f} to {100 * shares[-1]:.0f} %", highlight=False)
    _print_warnings(console, [f"{name}: {'; '.join(words)}" for name, words in batch.warnings.items()])
    _print_warnings(console, [f"{name}: {reason}" for name, reason in batch.problems.items()], "problem")


def show_diagnosis(found: Diagnosis) -> None:
    """What is wrong, or that nothing is; rows and the depth error to expect."""
    console = Console()
    if found.is_healthy:
        console.print("healthy: nothing wrong was found", style="green")
    _print_warnings(console, found.problems, "problem")
    _print_warnings(console, found.notes)
    table = Table(box=None, show_header=False)
    table.add_row("features that match", str(found.num_matches))
    if found.vertical_median_px == found.vertical_median_px:
        _add_rows(table, found)
    console.print(table)
    if found.expectations:
        ranges = Table("depth", "disparity, px", "error from matching", "from calibration", box=None)
        for e in found.expectations:
            wrong = f"{e.from_calibration:.3g}" if e.from_calibration == e.from_calibration else "not known"
            ranges.add_row(f"{e.depth:g}", f"{e.disparity_px:.1f}", f"{e.from_matching:.3g}", wrong)
        console.print(ranges)


def _add_rows(table: Table, found: Diagnosis) -> None:
    table.add_row(
        "vertical offset",
        f"median {found.vertical_median_px:.2f} px, 95 % {found.vertical_p95_px:.2f} px, signed median "
        f"{found.vertical_signed_px:+.2f} px",
    )
    table.add_row(
        "left after the best extrinsics, after distortion",
        f"{found.after_extrinsics_px:.2f} px, {found.after_distortion_px:.2f} px",
    )
    if found.calibration_error_px == found.calibration_error_px:
        table.add_row("of the rig, likely in columns too", f"{found.calibration_error_px:.2f} px")
    for name, row in zip(("over the image, px: top", "middle", "bottom"), found.vertical_map_px):
        table.add_row(name, "  ".join(f"{value:+6.2f}" if value == value else "     -" for value in row))


def show_calibration(run: CalibrationRun) -> None:
    """The verdict, the cameras, and where the report is."""
    console, found = Console(), run.calibration
    console.print(
        run.verdict.sentence, style="green" if run.verdict.passes else "yellow", highlight=False, markup=False
    )
    for c, camera in enumerate(found.cameras):
        who = f"{('left', 'right')[c]} " if len(found.cameras) == 2 else ""
        table = Table(f"{who}{camera.model.name}", "value", "standard deviation", box=None)
        for name, value, sigma in zip(camera.model.param_names, camera.params, found.params_sigma(c)):
            table.add_row(name, f"{value:.6g}", f"{sigma:.2g}")
        console.print(table)
    if len(found.cameras) == 2:
        console.print(
            f"baseline {found.rig().baseline:.6g}, standard deviation {found.baseline_sigma():.2g}"
            + (" (in squares: give --square)" if found.config.board.square == 1.0 else ""),
            highlight=False,
        )
    if found.config.refine_warp:
        bend = ", ".join(f"{w:.3g}" for w in found.state.warp)
        console.print(f"middle of the board above its edges, across and down: {bend}", highlight=False)
    _print_warnings(console, run.problems.values())
    for c, states in enumerate(found.view_states):
        left_out = [
            f"{path.name}: {state.value}"
            for path, state in zip(run.pictures[c], states)
            if state.value != "used" and str(path) not in run.problems
        ]
        _print_warnings(console, left_out)
    console.print(
        f"calibration  {run.out / 'calibration.json'}\nreport       {run.out / 'report.html'}",
        highlight=False,
        markup=False,
    )


def _print_warnings(console: Console, warnings: Iterable[str], word: str = "note") -> None:
    for warning in warnings:
        console.print(f"{word}: {warning}", style="yellow", highlight=False, markup=False)
