"""`epipole surface`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from epipole.pipelines.sfm.command import STAGES
from epipole.pipelines.surfaces.config import FORMATS, SurfaceConfig

if TYPE_CHECKING:
    from epipole.pipelines.surfaces.run import SurfaceResult

DEFAULTS = SurfaceConfig()
WORDS = {
    **STAGES,
    "images": "Checking images",
    "depth": "Matching each view",
    "cloud": "Fusing points",
    "mesh": "Building the mesh",
    "texture": "Texturing the mesh",
    "survey": "Writing survey products",
}


def surface(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    config: Annotated[SurfaceConfig, tyro.conf.arg(name="")] = DEFAULTS,
) -> None:
    """Reconstruct surfaces from images, without a GPU: depth with an error bar, a dense cloud and a textured mesh.

    Args:
        source: Photographs or a video (reconstructed first), an output folder of `reconstruct`, a COLMAP model with its
            images, or a transforms.json.
        out: Output folder: cloud.ply, mesh.ply, textured.glb, report.html; with --until survey also dsm.tif, dtm.tif,
            contours.gpkg, orthophoto.tif and cloud.laz.
        config: Options.
    """
    from epipole.screen import progress_on_screen

    with progress_on_screen(WORDS, compiles_much=True) as progress:
        from epipole.pipelines.surfaces.run import surface as run

        result = run(source, out, config, progress)
    _show(result)


def _show(result: SurfaceResult) -> None:
    """Print the result and its location."""
    from rich.table import Table

    from epipole.screen import open_console, print_warnings, show_location

    console, summary = open_console(), result.summary
    table = Table(box=None, show_header=False)
    sigma = summary["relative_sigma"]
    accuracy = "" if sigma is None else f", standard deviation {100 * sigma:.2g} % of the depth (median)"
    table.add_row(
        f"depth of {summary['num_views']} views", f"{100 * summary['density']:.0f} % of the pixels{accuracy}"
    )
    files = {}
    if "num_points" in summary:
        table.add_row("cloud", f"{summary['num_points']:,} points")
        files["cloud"] = result.out / "cloud.ply"
        if (result.out / "cloud.laz").is_file():
            files["cloud as LAZ"] = result.out / "cloud.laz"
    if "num_faces" in summary:
        removed = ""
        if summary["num_parts_removed"]:
            removed = f"; {summary['num_parts_removed']:,} of {summary['num_parts']:,} parts removed as too small (--min-component)"
        closed = ""
        if summary["num_holes_closed"]:
            closed = f"; {summary['num_holes_closed']:,} holes closed"
        table.add_row("mesh", f"{summary['num_faces']:,} triangles{removed}{closed}")
        files["mesh"] = result.out / "mesh.ply"
    if "texture_size_px" in summary:
        width, height = summary["texture_size_px"]
        table.add_row("texture", f"{width} x {height} pixels")
        written = (result.out / f"textured.{suffix}" for suffix in FORMATS)
        files["textured"] = next(path for path in written if path.is_file())
    if "raster_size" in summary:
        width, height = summary["raster_size"]
        table.add_row(
            "survey", f"{width} x {height} cells of {summary['resolution_m']:g} m in {summary['crs']}"
        )
        files |= {
            "heights": result.out / "dsm.tif",
            "ground": result.out / "dtm.tif",
            "contour lines": result.out / "contours.gpkg",
            "orthophoto": result.out / "orthophoto.tif",
        }
    table.add_row("time", f"{summary['seconds']:.1f} s")
    console.print(table)
    print_warnings(console, result.warnings)
    show_location(console, result.out, files)
