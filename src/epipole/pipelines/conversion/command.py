"""`epipole convert`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from epipole.config import ModelFormat


def convert(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")],
    target: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TARGET")],
    format: Annotated[ModelFormat | None, tyro.conf.arg(metavar="FORMAT")] = None,
) -> None:
    """Convert a model or a splat to another format.

    Args:
        source: Output folder of a reconstruction, a COLMAP model, a transforms.json, or files of OpenSfM, Metashape, RealityScan, Bundler, kapture or Nuke; for splat a file of Gaussians.
        target: A file for PLY, chan, USD and splat (.ply, .chan, .usdc, .spz ...), otherwise a new folder, to which all formats but COLMAP's also write the images.
        format: txt or bin (COLMAP), ply, transforms (nerfstudio), bundler, opensfm, metashape, realityscan, kapture, chan (Nuke), usd or splat; required unless the target's suffix determines it.
    """
    from epipole.io.convert import IMAGE_FOLDER, IMAGE_FOLDERS
    from epipole.pipelines.conversion.run import convert as run
    from epipole.screen import open_console, print_warnings, working

    with working():
        done = run(source, target, format)
    console = open_console()
    images = f" with {done.num_images} images" if done.num_images else ""
    console.print(f"Written {done.out}{images}", highlight=False, markup=False)
    print_warnings(console, [*done.warnings, *done.losses])
    if done.missing:
        folder = done.out / IMAGE_FOLDERS.get(format or "", IMAGE_FOLDER)
        note = f"{len(done.missing)} images were not found (such as {done.missing[0]}): copy them to {folder}"
        print_warnings(console, [note])
