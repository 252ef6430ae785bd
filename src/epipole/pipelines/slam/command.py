"""`epipole slam`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from epipole.pipelines.slam.config import CameraOptions, JobOptions, SlamConfig

if TYPE_CHECKING:
    from epipole.pipelines.slam.run import SlamResult

DEFAULTS, NO_CAMERA, ALL_FRAMES = SlamConfig(), CameraOptions(), JobOptions()
INTERRUPTED = 130
"""Exit code after Ctrl-C, as of every command."""


def slam(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    job: Annotated[JobOptions, tyro.conf.arg(name="")] = ALL_FRAMES,
    camera: Annotated[CameraOptions, tyro.conf.arg(name="")] = NO_CAMERA,
    config: Annotated[SlamConfig, tyro.conf.arg(name="")] = DEFAULTS,
) -> None:
    """Follow a moving camera: its path, frame by frame, and the map that it sees. Ctrl-C ends it, and writes what there is.

    Args:
        source: A 7-Scenes, TUM RGB-D, EuRoC or KITTI odometry folder, a folder of pictures, a video, a recording of ROS
            (.bag, .db3, .mcap, or the folder of a ROS 2 bag), or the number of a camera, such as 0.
        out: Output folder.
        job: What is taken of the source, and what is written.
        camera: What is known of the camera, for sources that do not tell.
        config: Options.
    """
    from epipole.screen import progress_on_screen

    with progress_on_screen({"track": "Following the camera", "adjust": "Adjusting the map"}) as progress:
        from epipole.pipelines.slam.run import slam as run

        result = run(source, out, config, job, camera, progress)
    show_slam(result)
    if result.summary["interrupted"] and not result.summary["is_live"]:
        sys.exit(INTERRUPTED)  # what was asked for is not done; a camera ends in no other way


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
    if summary["num_dropped"]:
        table.add_row("frames dropped", f"{summary['num_dropped']}, to keep up")
    if summary["interrupted"]:
        table.add_row("ended", "by Ctrl-C")
    table.add_row("map", f"{summary['num_keyframes']} keyframes, {summary['num_points']:,} points")
    length = result.trajectory.path_length()
    unit = "m" if summary["is_metric"] else "units of the map, not metres"
    table.add_row("length of the path", f"{length:.4g} {unit}")
    table.add_row("scale", summary["scale"])
    ms = summary["ms_per_frame"]
    table.add_row("time for a frame", f"{ms['median']:.1f} ms (median), {ms['p95']:.1f} ms (95 %)")
    console.print(table)
    for reason, count in summary["reasons"].items():
        console.print(f"  {count} frames without a place: {reason}", highlight=False, markup=False)
    print_warnings(console, result.warnings[:10])
    console.print(f"path    {result.out / 'trajectory.txt'}", highlight=False, markup=False)
    console.print(f"look    epipole view {result.out}", highlight=False, markup=False)
