"""`epipole demo`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from epipole._terminal import say
from epipole.pipelines.sfm.command import STAGES, show_reconstruction

if TYPE_CHECKING:
    from epipole.pipelines.demo.run import DemoResult


def demo(
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")] = Path("demo"),
    num_views: int = 24,
) -> None:
    """Reconstruct a rendered scene, and compare with the truth.

    Args:
        out: Output folder.
        num_views: Number of photographs to render.
    """
    from epipole.screen import progress_on_screen

    with progress_on_screen({"render": "Rendering", **STAGES}, compiles_much=True) as progress:
        from epipole.pipelines.demo.run import demo as run

        result = run(out, num_views, progress)
    show_reconstruction(result.reconstruction)
    show_comparison(result)
    if not result.success:
        say("epipole: the demo's reconstruction is not accurate enough", to_stderr=True)
        sys.exit(1)


def show_comparison(result: DemoResult) -> None:
    """Print the errors of the model."""
    from rich.table import Table

    from epipole.screen import open_console

    errors = result.errors
    table = Table(title="Against the exact truth", box=None, show_header=False)
    table.add_row("images registered", f"{result.num_registered} of {result.num_views}")
    table.add_row(
        "position error",
        f"mean {1000 * errors.mean_position:.2f} mm = {100 * result.relative_error:.4f} % of the scene"
        f" ({result.size_m:.1f} m)",
    )
    table.add_row("rotation error", f"mean {errors.mean_rotation_deg:.4f} degrees")
    open_console().print(table)
