"""`epipole slam`."""

from __future__ import annotations

import sys
import threading
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from epipole.pipelines.slam.config import CameraOptions, SlamConfig, WatchOptions

if TYPE_CHECKING:
    from epipole.pipelines.slam.run import SlamResult

DEFAULTS, NO_CAMERA, UNWATCHED = SlamConfig(), CameraOptions(), WatchOptions()


def slam(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    sensor: Literal["auto", "mono", "stereo", "rgbd"] = "auto",
    camera: Annotated[CameraOptions, tyro.conf.arg(name="")] = NO_CAMERA,
    watch: Annotated[WatchOptions, tyro.conf.arg(name="")] = UNWATCHED,
    config: Annotated[SlamConfig, tyro.conf.arg(name="")] = DEFAULTS,
) -> None:
    """Follow a moving camera: its path, frame by frame, and the map that it sees.

    Args:
        source: A 7-Scenes, TUM RGB-D, EuRoC or KITTI odometry folder, a folder of pictures, or a video.
        out: Output folder.
        sensor: What to use; auto takes depth, else a second camera, where there is one.
        camera: What is known of the camera, for sources that do not tell.
        watch: The true path, and the live view.
        config: Options.
    """
    from epipole.screen import progress_on_screen

    with progress_on_screen({"track": "Following the camera", "adjust": "Adjusting the map"}) as progress:
        from epipole.pipelines.slam.run import slam as run

        named = {field.name: getattr(watch, field.name) for field in fields(watch)}
        result = run(source, out, config, sensor, camera, progress, **named)
    show_slam(result)
    if watch.view:
        _stay(result.out, watch)


def show_slam(result: SlamResult) -> None:
    """Print how much of the path is known, and where it is."""
    from rich.console import Console
    from rich.table import Table

    from epipole.screen import print_warnings

    summary, console = result.summary, Console()
    table = Table(box=None, show_header=False)
    causal = summary["num_placed_causal"]
    table.add_row(
        "frames with a place", f"{summary['num_placed']} of {summary['num_frames']} ({causal} as they came)"
    )
    table.add_row("map", f"{summary['num_keyframes']} keyframes, {summary['num_points']:,} points")
    if summary["mean_reprojection_error_px"] is not None:
        table.add_row("reprojection error", f"{summary['mean_reprojection_error_px']:.2f} px (mean)")
    length = result.trajectory.path_length()
    unit = "m" if summary["is_metric"] else "units of the map, not metres"
    table.add_row("length of the path", f"{length:.4g} {unit}")
    table.add_row("scale", summary["scale"])
    ms = summary["ms_per_frame"]
    for name, found in summary.get("truth", {}).items():
        if name in ("final", "causal") and found is not None:
            table.add_row(f"error, {name} path", _error_words(found, is_metric=summary["is_metric"]))
    table.add_row("time for a frame", f"{ms['median']:.1f} ms (median), {ms['p95']:.1f} ms (95 %)")
    console.print(table)
    for reason, count in summary["reasons"].items():
        console.print(
            f"  {count} {'frame' if count == 1 else 'frames'} without a place as they came: {reason}",
            highlight=False,
            markup=False,
        )
    print_warnings(console, result.warnings[:10])
    console.print(f"path    {result.out / 'trajectory.txt'}", highlight=False, markup=False)
    console.print(f"report  {result.out / 'report.html'}", highlight=False, markup=False)
    console.print(f"look    epipole view {result.out}", highlight=False, markup=False)


def _error_words(found: dict[str, Any], *, is_metric: bool) -> str:
    """ATE and RPE with the alignment that the scale allows."""
    score, alignment = (found["rigid"], "SE(3)") if is_metric else (found["similarity"], "Sim(3)")
    return (
        f"ATE {score['ate_rmse']:.4g} (rmse, {alignment}), RPE {score['step_rmse']:.3g}, in the truth's unit;"
        f" {100 * found['coverage']:.1f} % of the frames compared"
    )


def _stay(out: Path, watch: WatchOptions) -> None:
    """Go on to show what was made, at the live view's address, until Ctrl-C."""
    from epipole.errors import FileFormatError
    from epipole.pipelines.slam.scene import show

    try:
        handle = show(out, port=watch.port, host=watch.host, block=False)
    except FileFormatError as error:
        print(f"epipole: {error}", file=sys.stderr)
        return
    print(f"Viewer at {handle.url} (Ctrl-C stops it)", flush=True)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        handle.stop()
