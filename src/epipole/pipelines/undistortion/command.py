"""`epipole undistort`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro


def undistort(out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]) -> None:
    """Write OUT/undistorted: pictures without distortion and a PINHOLE model, for splat trainers and MVS.

    Args:
        out: Output folder of a reconstruction.
    """
    from epipole.screen import progress_on_screen

    with progress_on_screen({"undistort": "Undistorting"}) as progress:
        from epipole.pipelines.undistortion.run import undistort as run

        target = run(out, progress)
    print(f"Undistorted pictures and model in {target}")
