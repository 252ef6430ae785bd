"""`epipole convert`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro


def convert(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")],
    target: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TARGET")],
    format: Literal["txt", "bin", "ply", "transforms", "bundler", "splat"] | None = None,
) -> None:
    """Write a model in another format.

    Args:
        source: Output folder of a reconstruction, a COLMAP model, or a transforms.json; for splat a file of Gaussians.
        target: For PLY and splat a file (splat: .ply, .compressed.ply, .spz, .sog or .splat), otherwise a new folder; transforms and bundler get their images, too.
        format: COLMAP txt or bin, PLY, nerfstudio transforms.json, Bundler, or splat; needed where the target's name does not tell it.
    """
    from epipole.pipelines.conversion.run import convert as run
    from epipole.screen import open_console, print_warnings, working

    with working():
        done = run(source, target, format)
    console = open_console()
    images = f" with {done.num_images} images" if done.num_images else ""
    console.print(f"Written {done.out}{images}", highlight=False, markup=False)
    print_warnings(console, [*done.warnings, *done.losses])
    if done.missing:
        note = f"{len(done.missing)} images were not found ({done.missing[0]} first): put them into {done.out}/images"
        print_warnings(console, [note])
