"""`epipole convert`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro


def convert(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")],
    target: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TARGET")],
    format: Literal["txt", "bin", "ply", "transforms", "bundler"],
) -> None:
    """Write a model in another format.

    Args:
        source: Output folder of a reconstruction, or a model.
        target: Where to write: a folder for txt and bin, a file for the others.
        format: COLMAP txt or bin, PLY, nerfstudio transforms.json, or Bundler.
    """
    from epipole.pipelines.conversion.run import convert as run

    print(f"Written {run(source, target, format)}")
