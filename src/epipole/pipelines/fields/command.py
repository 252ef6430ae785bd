"""`epipole splat`, `epipole nerf`, `epipole render`, `epipole mesh` and `epipole compare-fields`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import tyro

if TYPE_CHECKING:
    from rich.table import Table

from epipole.pipelines.fields.config import MeshConfig, NerfConfig, RenderConfig, SplatConfig
from epipole.pipelines.sfm.command import STAGES

DEFAULTS, MARCHED, CIRCLE, WHOLE = SplatConfig(), NerfConfig(), RenderConfig(), MeshConfig()
WORDS = {
    **STAGES,
    "load": "Reading images",
    "start": "Preparing the training",
    "train": "Training",
    "test": "Rendering held-out views",
}
INTERRUPTED = 130
"""Exit code after Ctrl-C, as for every command."""


def splat(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    config: Annotated[SplatConfig, tyro.conf.arg(name="")] = DEFAULTS,
) -> None:
    """Train Gaussian splats on images, without a GPU. Ctrl-C ends the training and keeps the result.

    Args:
        source: Photographs or a video (reconstructed first), an output folder of `reconstruct`, a COLMAP model with its
            images, or a transforms.json.
        out: Output folder: splat.ply, test/NAME.png, metrics.json, report.html.
        config: Options.
    """
    from epipole.screen import progress_on_screen

    with progress_on_screen(WORDS) as progress:
        from epipole.pipelines.fields.run import splat as run

        result = run(source, out, config, progress)
    _show(result.summary, result.warnings, "num_gaussians", result.out / "splat.ply")


def nerf(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    config: Annotated[NerfConfig, tyro.conf.arg(name="")] = MARCHED,
) -> None:
    """Train a radiance field on images, without a GPU. The field is a neural one, or a grid. Ctrl-C ends the training and keeps the result.

    Args:
        source: Photographs or a video, an output folder of `reconstruct`, a COLMAP model, or a transforms.json.
        out: Output folder: hash.npz or grid.npz, test/NAME.png, metrics.json, report.html.
        config: Options.
    """
    from epipole.screen import progress_on_screen

    with progress_on_screen(WORDS) as progress:
        from epipole.pipelines.fields.run import nerf as run

        result = run(source, out, config, progress)
        from epipole.pipelines.fields.kinds import KINDS

    kind = KINDS[config.kind]
    _show(result.summary, result.warnings, kind.count, result.out / kind.file)


def render(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SPLAT")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    config: Annotated[RenderConfig, tyro.conf.arg(name="")] = CIRCLE,
) -> None:
    """Render splats or a radiance field: to a video or images, along the given cameras or an orbit.

    Args:
        source: Output folder of `splat` or `nerf`, or a file of Gaussians (.ply, .compressed.ply, .spz, .sog, .splat).
        out: A video (.mp4, or .gif), or a folder for PNG images.
        config: Cameras and image size.
    """
    from epipole.screen import open_console, progress_on_screen

    with progress_on_screen({"render": "Rendering"}) as progress:
        from epipole.pipelines.fields.rendering.run import render as run

        done = run(source, out, config, progress)
    text = f"Written {done.out}: {done.num_frames} images, rendered at {done.frames_per_s:.1f} per second"
    open_console().print(text, highlight=False, markup=False)


def mesh(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FIELD")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MESH")],
    config: Annotated[MeshConfig, tyro.conf.arg(name="")] = WHOLE,
) -> None:
    """Extract a mesh from splats or a radiance field, by fusing the depth rendered from all cameras.

    Args:
        source: Output folder of `splat` or `nerf`, or a file of Gaussians with --cameras.
        out: The mesh, a PLY file with colors.
        config: Cameras and resolution.
    """
    from epipole.screen import open_console, progress_on_screen

    with progress_on_screen({"fuse": "Fusing depth"}) as progress:
        from epipole.pipelines.fields.meshing import mesh as run

        found = run(source, out, config, progress)
    text = f"Written {out}: {len(found.vertices_in_world):,} vertices, {len(found):,} triangles"
    if found.num_removed:
        text += (
            f"; removed {found.num_removed:,} of {found.num_components:,} components with fewer triangles than"
            f" {100 * config.min_component:g} % of the largest (--min-component)"
        )
    open_console().print(text, highlight=False, markup=False)


def compare_fields(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    config: Annotated[NerfConfig, tyro.conf.arg(name="")] = MARCHED,
) -> None:
    """Compare splats with a radiance field: quality, speed and work per pixel after the same training time.

    Args:
        source: Photographs or a video, an output folder of `reconstruct`, a COLMAP model, or a transforms.json.
        out: Output folder: splat, nerf, images/NAME.png (image, Gaussians, field), compare.json.
        config: Options, including the field to compare with.
    """
    from epipole.screen import open_console, print_warnings, progress_on_screen

    with progress_on_screen({**WORDS, "compare": "Comparing"}) as progress:
        from epipole.pipelines.fields.comparison import compare_fields as run

        result = run(source, out, config, progress)
    console = open_console()
    console.print(_compared(result.rows, config.kind))
    print_warnings(console, result.warnings, rest_in=str(result.out / "compare.json"))
    console.print(f"written   {result.out}", highlight=False, markup=False)
    if result.is_interrupted:
        sys.exit(INTERRUPTED)


def _compared(rows: dict[str, dict[str, Any]], kind: str) -> Table:
    from rich.table import Table

    table = Table("", "PSNR", "SSIM", "trained", "images per second", "per pixel")
    names = {"splat": "Gaussians", "nerf": "neural field" if kind == "hash" else "grid"}
    for name, row in rows.items():
        work = (
            f"{row['queries']:.1f} queries"
            if "queries" in row
            else f"{row['evaluated']:.1f} pairs evaluated, {row['useful']:.1f} useful"
        )
        similarity = f"{row['psnr']:.2f} dB", f"{row['ssim']:.3f}"
        table.add_row(names[name], *similarity, f"{row['train_s']:.0f} s", f"{row['frames_s']:.1f}", work)
    return table


def _show(summary: dict[str, Any], warnings: Sequence[str], count: str, model: Path) -> None:
    """Print the result of a training; exits with the code of Ctrl-C if that ended it."""
    from rich.table import Table

    from epipole.screen import open_console, print_warnings

    console, table = open_console(), Table(box=None, show_header=False)
    table.add_row(count.removeprefix("num_"), f"{summary[count]:,}")
    table.add_row(
        "trained",
        f"{summary['steps']} steps in {summary['train_s']:.0f} s on {summary['num_train']} images",
    )
    if summary["psnr"] is not None:
        test, compared = summary["num_test"], summary["num_compared"]
        of_all = "" if compared == test else f"{compared} of "
        held_out = f"{of_all}{test} held-out image{'s' if test > 1 else ''}"
        table.add_row("quality", f"PSNR {summary['psnr']:.2f} dB, SSIM {summary['ssim']:.3f} ({held_out})")
    if summary["interrupted"]:
        table.add_row("ended", "by Ctrl-C")
    console.print(table)
    print_warnings(console, warnings, rest_in=str(model.parent / "summary.json"))
    console.print(f"written   {model}", highlight=False, markup=False)
    console.print(f"report    {model.parent / 'report.html'}", highlight=False, markup=False)
    folder = quote(str(model.parent))
    console.print(f"view      epipole view {folder}", highlight=False, markup=False)
    console.print(f"video     epipole render {folder} round.mp4", highlight=False, markup=False)
    if summary["interrupted"]:
        sys.exit(INTERRUPTED)
