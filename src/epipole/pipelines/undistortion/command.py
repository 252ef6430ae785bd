"""`epipole undistort`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from epipole._terminal import say


def undistort(
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    target: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[DEST]")] = None,
    model: int | None = None,
    stmaps: bool = False,
    cluster: str | None = None,
    shared_folder: bool = True,
) -> None:
    """Undistort images: write them with a PINHOLE model, for splat trainers and MVS.

    Args:
        out: Output folder of a reconstruction, or one of its models (OUT/sparse/1).
        target: Where to write; default OUT/undistorted, or OUT/undistorted-1 for model 1.
        model: Number of the model in OUT/sparse, if there are several; the largest is 0.
        stmaps: Also write STMaps (TIFF) that undistort and distort images in Nuke and similar programs.
        cluster: Process images on a Dask cluster: tcp://HOST:PORT, tls://HOST:PORT, local:N or slurm:N.
        shared_folder: All machines of the cluster see images and output folder under the same paths; otherwise files are sent.
    """
    from epipole.screen import progress_on_screen

    with progress_on_screen({"undistort": "Undistorting"}) as progress:
        from epipole.pipelines.undistortion.run import undistort as run
        from epipole.runs import Cluster

        executor = None if cluster is None else Cluster(cluster, shared_folder)
        folder = run(out, progress, target=target, model=model, stmaps=stmaps, executor=executor)
    say(f"Undistorted images and model in {folder}")
