"""`epipole localize`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from epipole.pipelines.localization.config import LocalizeConfig
from epipole.pipelines.sfm.command import STAGES

if TYPE_CHECKING:
    from epipole.pipelines.localization.run import LocalizationResult

DEFAULTS = LocalizeConfig()
WORDS = {**STAGES, "open": "Opening the model", "localize": "Localizing images"}


def localize(
    images: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES")],
    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="WORKSPACE")],
    out: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[OUT]")] = None,
    config: Annotated[LocalizeConfig, tyro.conf.arg(name=""), tyro.conf.UseAppendAction] = DEFAULTS,
) -> None:
    """Localize new images in a finished model, with error bars; the model does not change.

    Args:
        images: Folder of photographs, one photograph, or a video.
        workspace: Output folder of `reconstruct`, or a COLMAP model beside its database.db.
        out: Output folder. Default: WORKSPACE/localized.
        config: Options.
    """
    from epipole.screen import progress_on_screen

    with progress_on_screen(WORDS) as progress:
        from epipole.pipelines.localization.run import localize as run

        result = run(images, workspace, out, config, progress)
    _show(result)


def _show(result: LocalizationResult) -> None:
    """Print the result and its location."""
    from rich.table import Table

    from epipole.screen import open_console, print_warnings, show_location, show_reasons

    console, summary = open_console(), result.summary
    table = Table(box=None, show_header=False)
    table.add_row("images localized", f"{summary['num_localized']} of {summary['num_images']}")
    if summary["median_error_px"] is not None:
        table.add_row("reprojection error", f"{summary['median_error_px']:.2f} px")
    times = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in result.summary["timings_s"].items())
    table.add_row("time", f"{summary['seconds']:.1f} s (stages: {times})")
    console.print(table)
    print_warnings(console, result.warnings)
    show_reasons(console, result.reasons)
    show_location(console, result.out, {"poses": result.out / "poses.txt"})
