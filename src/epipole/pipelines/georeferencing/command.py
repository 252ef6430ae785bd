"""`epipole georeference`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from epipole.pipelines.georeferencing.config import GeoreferenceConfig

if TYPE_CHECKING:
    from epipole.pipelines.georeferencing.run import GeoreferenceResult

DEFAULTS = GeoreferenceConfig()
WORDS = {
    "open": "Opening the model",
    "read": "Reading GPS positions",
    "adjust": "Adjusting the model",
    "write": "Writing the results",
}


def georeference(
    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="WORKSPACE")],
    out: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[OUT]")] = None,
    config: Annotated[GeoreferenceConfig, tyro.conf.arg(name=""), tyro.conf.UseAppendAction] = DEFAULTS,
) -> None:
    """Georeference a finished model with control points and GPS, with error bars.

    Args:
        workspace: Output folder of `reconstruct`, or a COLMAP model.
        out: Output folder. Default: WORKSPACE/georeferenced.
        config: Options.
    """
    from epipole.screen import progress_on_screen

    with progress_on_screen(WORDS) as progress:
        from epipole.pipelines.georeferencing.run import georeference as run

        result = run(workspace, out, config, progress)
    _show(result)


def _show(result: GeoreferenceResult) -> None:
    """Print the result and its location."""
    from rich.table import Table

    from epipole.pipelines.georeferencing.results import AXES
    from epipole.screen import open_console, print_warnings, show_location

    console, summary = open_console(), result.summary
    table = Table(box=None, show_header=False)
    for role in ("control", "check"):
        if count := summary[f"num_{role}"]:
            rms = ", ".join(
                f"{word} {summary['rms_m'][role][axis]:.3f} m"
                for word, axis in zip(("east", "north", "up"), AXES)
                if summary["rms_m"][role][axis] is not None
            )
            table.add_row(f"{count} {role} points", f"RMS residual {rms}")
    if summary["num_gps"]:
        table.add_row(
            f"{summary['num_gps']} GPS positions", f"median residual {summary['median_gps_residual_m']:.2f} m"
        )
    sigma = [value for value in summary["median_image_sigma_m"].values() if value is not None]
    if sigma:
        table.add_row("position of an image", f"standard deviation {max(sigma):.2g} m (median)")
    if summary["georeference"] is not None:
        at = summary["georeference"]
        table.add_row("origin", f"{at['lat_deg']:.7f}, {at['lon_deg']:.7f}, {at['alt_m']:.2f} m")
    table.add_row("time", f"{summary['seconds']:.1f} s")
    console.print(table)
    print_warnings(console, result.warnings)
    show_location(
        console,
        result.out,
        {"model": result.out / "sparse" / "0", "points": result.out / "control_points.json"},
    )
