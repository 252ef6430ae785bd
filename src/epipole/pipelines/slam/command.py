"""`epipole slam`."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from epipole._terminal import say
from epipole.pipelines.sfm.command import STAGES
from epipole.pipelines.slam.config import JobOptions, SlamConfig

if TYPE_CHECKING:
    from epipole.pipelines.slam.output.results import SlamResult

DEFAULTS = SlamConfig()
LEAST_SHIFT_REPORTED_PX = 0.1
INTERRUPTED = 130
"""Exit code after Ctrl-C, as in every command."""


def slam(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    config: Annotated[SlamConfig, tyro.conf.arg(name=""), tyro.conf.UseAppendAction] = DEFAULTS,
) -> None:
    """Track a moving camera and map the scene. Ctrl-C stops early and writes the results so far.

    Args:
        source: A 7-Scenes, TUM RGB-D, EuRoC or KITTI odometry folder, a folder of images, a video, a ROS bag
            (.bag, .db3, .mcap, or the folder of a ROS 2 bag), the number of a camera, such as 0,
            or of two as a stereo pair, such as 0,1.
        out: Output folder.
        config: Options.
    """
    from epipole.screen import progress_on_screen

    words = {
        **STAGES,
        "choose": "Choosing images",
        "merge": "Merging maps",
        "track": "Tracking the camera",
        "adjust": "Optimizing the map",
        "depth": "Reading depth",
        "mesh": "Building the mesh",
    }
    with progress_on_screen(words) as progress:
        from epipole.pipelines.slam.run import slam as run

        result = run(source, out, config, progress)
    show_slam(result)
    if result.summary["interrupted"] and not result.summary["is_live"]:
        sys.exit(INTERRUPTED)  # incomplete, whereas a live camera always ends by Ctrl-C
    if config.view:
        _stay(result.out, config)


def show_slam(result: SlamResult) -> None:
    """Print the results of a run and where they are."""
    from rich.table import Table

    from epipole.screen import open_console, print_warnings

    summary, console = result.summary, open_console()
    table = Table(box=None, show_header=False)
    causal = summary["num_localized_causal"]
    table.add_row(
        "localized frames",
        f"{summary['num_localized']} of {summary['num_frames']} ({causal} when they arrived)",
    )
    if summary["num_dropped"]:
        table.add_row("frames dropped", f"{summary['num_dropped']}, to keep up")
    if summary["interrupted"]:
        table.add_row("stopped", "by Ctrl-C")
    table.add_row("map", f"{summary['num_keyframes']} keyframes, {summary['num_points']:,} points")
    if summary["mean_reprojection_error_px"] is not None:
        table.add_row("reprojection error", f"{summary['mean_reprojection_error_px']:.2f} px (mean)")
    closed = sum(loop["verdict"] == "accepted" for loop in summary["loops"])
    if closed:
        table.add_row("loop closures", f"{closed}" if closed > 1 else "1")
    for number, part in enumerate(summary["submaps"], 1):
        unit = ", up to scale" if summary["is_metric"] and not part["is_metric"] else ""
        words = f"{part['num_frames']} frames, not connected to the first map{unit}: trajectory_submap_{number}.txt"
        table.add_row("separate map", words)
    length = result.trajectory.path_length()
    unit = "m" if summary["is_metric"] else "map units, not meters"
    table.add_row("trajectory length", f"{length:.4g} {unit}")
    table.add_row("scale", summary["scale"])
    sigma = summary["sigma_position_median"]
    if sigma is not None and summary["is_metric"]:
        table.add_row(
            "position accuracy", f"{sigma:.2g} m (1 sigma, median; summary.json lists what it covers)"
        )
    if abs(summary["right_principal_point_shift_px"]) > LEAST_SHIFT_REPORTED_PX:
        shift = summary["right_principal_point_shift_px"]
        table.add_row("second camera", f"principal point {shift:+.2f} px off the calibration; corrected")
    for label, words in _source_rows(summary["source"]):
        table.add_row(label, words)
    ms = summary["ms_per_frame"]
    for name, found in summary.get("truth", {}).items():
        if name in ("final", "causal") and found is not None:
            table.add_row(f"error, {name} trajectory", _error_words(found, is_metric=summary["is_metric"]))
    if "mesh" in summary:
        table.add_row(
            "mesh", f"{summary['mesh']['num_faces']:,} triangles, voxels of {summary['mesh']['voxel']:.2g} m"
        )
    table.add_row("time per frame", f"{ms['median']:.1f} ms (median), {ms['p95']:.1f} ms (95 %)")
    console.print(table)
    for reason, count in summary["reasons"].items():
        console.print(
            f"  {count} {'frame' if count == 1 else 'frames'} without a pose when they arrived: {reason}",
            highlight=False,
            markup=False,
        )
    print_warnings(console, result.warnings, rest_in=str(result.out / "summary.json"))
    _print_files(result)


def _print_files(result: SlamResult) -> None:
    from epipole.screen import open_console

    console, summary = open_console(), result.summary
    console.print(f"trajectory  {result.out / 'trajectory.txt'}", highlight=False, markup=False)
    if "mesh" in summary:
        console.print(f"mesh        {result.out / 'mesh.ply'}", highlight=False, markup=False)
    console.print(f"report      {result.out / 'report.html'}", highlight=False, markup=False)
    console.print(f"viewer      epipole view {quote(str(result.out))}", highlight=False, markup=False)


def _source_rows(source: dict[str, Any]) -> list[tuple[str, str]]:
    """Sources of the intrinsics and of the depth unit."""
    out = []
    if source.get("camera_source"):
        out.append(("camera source", source["camera_source"]))
    if "depth_scale" in source:
        out.append(
            (
                "depth scale",
                f"{source['depth_scale']:g} values per meter, from {source['depth_scale_source']}",
            )
        )
    return out


def _error_words(found: dict[str, Any], *, is_metric: bool) -> str:
    """ATE and RPE, aligned with SE(3) for a metric trajectory and with Sim(3) otherwise."""
    score, alignment = (found["rigid"], "SE(3)") if is_metric else (found["similarity"], "Sim(3)")
    return (
        f"ATE {score['ate_rmse']:.4g} (rmse, {alignment}), RPE {score['step_rmse']:.3g}, in the truth's unit;"
        f" {100 * found['coverage']:.1f} % of the frames compared"
    )


def _stay(out: Path, job: JobOptions) -> None:
    """Show the results at the address of the live view until Ctrl-C."""
    from epipole.errors import FileFormatError
    from epipole.pipelines.slam.output.scene import scene
    from epipole.viewer import view_scene

    try:
        handle = view_scene(scene(out), port=job.port, host=job.host, block=False)
    except FileFormatError as error:
        say(f"epipole: {error}", to_stderr=True)
        return
    say(f"Viewer at {handle.url} (Ctrl-C stops it)")
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        handle.stop()
