"""`epipole view`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro


def view(
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    port: int | None = None,
    host: str = "127.0.0.1",
) -> None:
    """Show a model, a path with its map, the depth of a pair, or Gaussians in the browser.

    Args:
        out: Output folder of `reconstruct`, `slam`, `stereo` or `splat`, a COLMAP model, or a PLY file of Gaussians.
        port: The port to listen on; None: 8080, or the next free one if it is in use.
        host: The address to listen on; 0.0.0.0 lets other machines in.
    """
    import threading

    from epipole.pipelines.viewing.run import view as run

    handle = run(out, port=port, host=host, block=False)
    if handle.note:
        print(f"epipole: {handle.note}", file=sys.stderr)
    print(f"Viewer at {handle.url} (Ctrl-C stops it)", flush=True)
    try:
        threading.Event().wait()
    finally:
        handle.stop()
