"""`epipole convert`."""

from __future__ import annotations

import sys
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
        source: Output folder of a reconstruction, a COLMAP model, or a transforms.json.
        target: For PLY a file, otherwise a new folder; transforms and bundler get their pictures, too.
        format: COLMAP txt or bin, PLY, nerfstudio transforms.json, or Bundler.
    """
    from epipole.pipelines.conversion.run import convert as run

    done = run(source, target, format)
    pictures = f" with {done.num_pictures} pictures" if done.num_pictures else ""
    print(f"Written {done.out}{pictures}")
    if done.missing:
        print(
            f"note: {len(done.missing)} pictures were not found ({done.missing[0]} first): "
            f"{done.out} names them in images/, put them there",
            file=sys.stderr,
        )
