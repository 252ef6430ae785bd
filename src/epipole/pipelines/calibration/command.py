"""`epipole calibrate`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from epipole.pipelines.calibration.config import CalibrationConfig

if TYPE_CHECKING:
    from epipole.cameras import Camera
    from epipole.pipelines.calibration.files import CalibrationRun

DEFAULTS = CalibrationConfig()


def calibrate(
    images: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    config: Annotated[CalibrationConfig, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes] = DEFAULTS,
    right: Path | None = None,
    strict: bool = False,
) -> None:
    """Calibrate one or two cameras from images of a board: a chessboard, a ChArUco board or an AprilTag grid.

    The images of a pair are in sub-folders left and right, or named left01.jpg and right01.jpg. Principal points
    have the center of the first pixel at (0, 0), as in OpenCV, except in the line for `epipole reconstruct`, where
    they count from the corner of the image, as in COLMAP.

    Args:
        images: Folder of images.
        out: Output folder.
        config: Board and options.
        right: Folder of the right camera's images, if separate.
        strict: Exit with code 3 if the calibration fails its checks; results are still written.
    """
    from epipole.screen import ANSWER_IS_NO, progress_on_screen

    with progress_on_screen({"board": "Looking for the board", "calibrate": "Calibrating"}) as progress:
        from epipole.pipelines.calibration.run import calibrate as run

        result = run(images, out, config, right, progress)
    show_calibration(result)
    if strict and not result.verdict.passes:
        sys.exit(ANSWER_IS_NO)


def camera_options(camera: Camera) -> str:
    """The camera as options of `epipole reconstruct`, with the principal point from the corner of the image."""
    from epipole.io.colmap.model import params_to_colmap

    params = ",".join(f"{p:.8g}" for p in params_to_colmap(camera.model, camera.params))
    return f"--camera-model {camera.model.name} --camera-params {params}"


def show_calibration(run: CalibrationRun) -> None:
    """Print the verdict, the cameras, and the path of the report."""
    from rich.table import Table

    from epipole.screen import open_console, print_warnings

    console, found = open_console(), run.calibration
    console.print(
        run.verdict.sentence, style="green" if run.verdict.passes else "yellow", highlight=False, markup=False
    )
    for c, camera in enumerate(found.cameras):
        who = f"{('left', 'right')[c]} " if len(found.cameras) == 2 else ""
        table = Table(f"{who}{camera.model.name}", "value", "standard deviation", box=None)
        for name, value, sigma in zip(camera.model.param_names, camera.params, found.params_sigma(c)):
            table.add_row(name, f"{value:.6g}", f"{sigma:.2g}")
        console.print(table)
    console.print(
        "for `epipole reconstruct`, with the principal point from the corner of the image:", markup=False
    )
    for camera in found.cameras:
        console.print(f"  {camera_options(camera)}", highlight=False, markup=False, soft_wrap=True)
    if len(found.cameras) == 2:
        console.print(
            f"baseline {found.rig().baseline:.6g}, standard deviation {found.baseline_sigma():.2g}"
            + (" (in squares: pass --square)" if found.config.board.square == 1.0 else ""),
            highlight=False,
        )
    if found.config.refine_warp:
        bend = ", ".join(f"{w:.3g}" for w in found.state.warp)
        console.print(f"board center above its edges, horizontally and vertically: {bend}", highlight=False)
    print_warnings(console, run.problems.values())
    for c, states in enumerate(found.view_states):
        left_out = [
            f"{path.name}: {state.value}"
            for path, state in zip(run.images[c], states)
            if state.value != "used" and str(path) not in run.problems
        ]
        print_warnings(console, left_out)
    console.print(
        f"calibration  {run.out / 'calibration.json'}\nreport       {run.out / 'report.html'}",
        highlight=False,
        markup=False,
    )
