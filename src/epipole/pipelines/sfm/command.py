"""`epipole reconstruct` and `epipole merge`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from epipole.pipelines.sfm.config import ReconstructConfig

if TYPE_CHECKING:
    from epipole.pipelines.sfm.run import ReconstructionResult

DEFAULTS = ReconstructConfig()
STAGES = {
    "video": "Extracting frames",
    "read": "Reading headers",
    "digest": "Comparing files",
    "features": "Detecting features",
    "compile": "Compiling kernels",
    "pair": "Choosing pairs",
    "match": "Matching pairs",
    "verify": "Verifying pairs",
    "parts": "Mapping parts",
    "map": "Registering images",
    "adjust": "Adjusting the model",
    "complete": "Completing tracks",
    "rigs": "Adjusting rigs",
    "anchor": "Determining the scale",
    "write": "Writing images",
}


def reconstruct(
    images: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    config: Annotated[ReconstructConfig, tyro.conf.arg(name=""), tyro.conf.UseAppendAction] = DEFAULTS,
) -> None:
    """Reconstruct a 3D model from photographs; the defaults suit most images.

    Args:
        images: Folder of photographs (sub-folders too), or a video file.
        out: Output folder; an interrupted run is continued.
        config: Options.
    """
    from epipole.screen import progress_on_screen

    with progress_on_screen(STAGES, compiles_much=True) as progress:
        from epipole.pipelines.sfm.run import reconstruct as run

        result = run(images, out, config, progress)
    show_reconstruction(result)


def merge(
    first: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL1")],
    second: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL2")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    config: Annotated[ReconstructConfig, tyro.conf.arg(name=""), tyro.conf.UseAppendAction] = DEFAULTS,
) -> None:
    """Merge two finished models of overlapping images, in the coordinates of the first.

    Args:
        first: Output folder of `reconstruct`, or a COLMAP model with images and database.
        second: The other model.
        out: Output folder.
        config: Options.
    """
    from epipole.screen import progress_on_screen

    with progress_on_screen({**STAGES, "open": "Opening the models"}, compiles_much=True) as progress:
        from epipole.pipelines.sfm.merge import merge as run

        result = run([first, second], out, config, progress)
    show_reconstruction(result)


def show_reconstruction(result: ReconstructionResult) -> None:
    """Print the result and its location."""
    from rich.table import Table

    from epipole.pipelines.sfm.notes import rig_in_words
    from epipole.screen import open_console, print_warnings, show_location, show_reasons

    console, model, summary = open_console(), result.model, result.summary
    table = Table(box=None, show_header=False)
    table.add_row("images registered", f"{summary['num_registered']} of {summary['num_images']}")
    table.add_row("points", f"{len(model.points):,} ({len(model.tracks.image):,} observations)")
    error_px = summary["mean_reprojection_error_px"]
    table.add_row("reprojection error", "unknown" if error_px is None else f"{error_px:.2f} px")
    table.add_row("scale", summary["scale"])
    for prefix, entry in summary.get("rigs", {}).items():
        table.add_row(f"rig, {prefix}", rig_in_words(entry))
    if (poses := summary["poses"]) is not None:
        table.add_row(
            "poses",
            f"{poses['num_used']} of {poses['num_used'] + len(poses['not_used'])} known poses agree, deviations"
            f" {poses['median_position']:.3g}{' m' if summary['is_metric'] else ''} and"
            f" {poses['median_rotation_deg']:.2g} degrees (median)",
        )
    if summary["median_gps_residual_m"] is not None:
        table.add_row("GPS", f"{summary['median_gps_residual_m']:.1f} m from the GPS positions (median)")
    times = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in result.timings_s.items())
    earlier = ", including earlier runs" if sum(result.timings_s.values()) > summary["seconds"] else ""
    table.add_row("time", f"{summary['seconds']:.1f} s (stages{earlier}: {times})")
    if summary["compile_seconds"] > 1:
        table.add_row("", f"of which compiling kernels, once per machine: {summary['compile_seconds']:.0f} s")
    console.print(table)
    print_warnings(console, result.warnings)
    show_reasons(console, result.reasons)
    show_location(console, result.out, {"model": result.out / "sparse" / "0"})
