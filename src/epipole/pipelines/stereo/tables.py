"""Terminal output of the stereo commands."""

from __future__ import annotations

from shlex import quote

import numpy as np
from rich.table import Table

from epipole.pipelines.stereo.doctor import Diagnosis
from epipole.pipelines.stereo.pair import StereoResult
from epipole.pipelines.stereo.pairs import StereoBatch
from epipole.scene import StereoReason
from epipole.screen import open_console, print_warnings


def show_stereo(result: StereoResult) -> None:
    """Print a summary of the pair and the paths of the results."""
    found = result.disparities
    known = np.isfinite(found.disparity_px)
    table = Table(title=f"Stereo pair: {100 * found.density:.1f} % of the pixels known", show_header=False)
    for reason in StereoReason:
        fraction = float((found.reason == reason).mean())
        if fraction > 0 and reason != StereoReason.OK:
            table.add_row(reason.name.lower().replace("_", " "), f"{100 * fraction:.1f} %")
    if known.any():
        low, high = np.percentile(found.disparity_px[known], (1, 99))
        table.add_row("disparities", f"{low:.1f} to {high:.1f} px")
        table.add_row("median standard deviation", f"{np.median(found.sigma_px[known]):.2f} px")
    if result.depths is not None and np.isfinite(result.depths.depth).any():
        near, far = np.nanpercentile(result.depths.depth, (1, 99))
        table.add_row(f"depths, in {result.unit}", f"{near:.3g} to {far:.3g}")
        table.add_row("points", f"{result.num_points}")
    console = open_console()
    console.print(table)
    print_warnings(console, result.warnings)
    if result.out is not None:
        descriptor = "" if result.depths is None else f"\nview     epipole view {quote(str(result.out))}"
        words = f"results  {result.out}\nreport   {result.out / 'report.html'}{descriptor}"
        console.print(words, highlight=False, markup=False)


def show_batch(batch: StereoBatch) -> None:
    """Print the number of pairs that were measured, and the problems of the others."""
    console = open_console()
    earlier = f", {len(batch.earlier)} by an earlier run" if batch.earlier else ""
    console.print(f"{len(batch.done)} pairs measured{earlier}, results in {batch.out}", highlight=False)
    if batch.known:
        fractions = sorted(batch.known.values())
        console.print(
            f"known pixels: {100 * fractions[0]:.0f} to {100 * fractions[-1]:.0f} %", highlight=False
        )
    print_warnings(console, [f"{name}: {'; '.join(words)}" for name, words in batch.warnings.items()])
    print_warnings(console, [f"{name}: {reason}" for name, reason in batch.problems.items()], "problem")


def show_diagnosis(found: Diagnosis) -> None:
    """Print problems, vertical offsets and the expected depth error."""
    console = open_console()
    if found.is_healthy:
        console.print("healthy: no problems found", style="green")
    print_warnings(console, found.problems, "problem")
    print_warnings(console, found.notes)
    table = Table(box=None, show_header=False)
    table.add_row("feature matches", str(found.num_matches))
    if found.vertical_median_px == found.vertical_median_px:
        _add_rows(table, found)
    console.print(table)
    if found.expectations:
        ranges = Table("depth", "disparity, px", "error from matching", "from calibration", box=None)
        for e in found.expectations:
            wrong = f"{e.from_calibration:.3g}" if e.from_calibration == e.from_calibration else "unknown"
            ranges.add_row(f"{e.depth:g}", f"{e.disparity_px:.1f}", f"{e.from_matching:.3g}", wrong)
        console.print(ranges)


def _add_rows(table: Table, found: Diagnosis) -> None:
    table.add_row(
        "vertical offset",
        f"median {found.vertical_median_px:.2f} px, 95 % {found.vertical_p95_px:.2f} px, signed median "
        f"{found.vertical_signed_px:+.2f} px",
    )
    table.add_row(
        "after fitting the rig, and also the distortion",
        f"{found.after_extrinsics_px:.2f} px, {found.after_distortion_px:.2f} px",
    )
    if found.calibration_error_px == found.calibration_error_px:
        table.add_row("explained by the rig, likely also in columns", f"{found.calibration_error_px:.2f} px")
    for name, row in zip(("over the image, px: top", "middle", "bottom"), found.vertical_map_px):
        table.add_row(name, "  ".join(f"{value:+6.2f}" if value == value else "     -" for value in row))
