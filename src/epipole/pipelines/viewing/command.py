"""`epipole view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from epipole._terminal import say
from epipole.pipelines.viewing.config import USUAL_SHARED


def view(
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")],
    port: int | None = None,
    host: str = "127.0.0.1",
    share: Path | None = None,
    share_max: int = USUAL_SHARED,
) -> None:
    """Show any result or file in the browser: model, trajectory with map, depth, Gaussians, points, mesh, calibration.

    Args:
        out: Output folder of a job, a COLMAP model, or a file: PLY, GLB, SPZ, SOG (or its meta.json), .splat, depth map (PFM, 16-bit PNG), trajectory, map, calibration.
        port: The port to listen on; None: 8080, or the next free one if it is in use.
        host: The address to listen on; 0.0.0.0 allows connections from other machines.
        share: Write a single .html file that any browser can show instead, and start no server.
        share_max: Most points (sampled) and Gaussians (merged) in that file; 10 bytes each for a textured mesh.
    """
    import threading

    from epipole.pipelines.viewing.run import view as run
    from epipole.pipelines.viewing.run import write_page
    from epipole.screen import working

    if share is not None:
        with working():
            page = write_page(out, share, share_max)
        say(f"Written {page.file} ({page.num_bytes / 1e6:.1f} MB): {page.shown}")
        return
    with working():
        handle = run(out, port=port, host=host, block=False)
    if handle.note:
        say(f"epipole: {handle.note}", to_stderr=True)
    say(f"Viewer at {handle.url} (Ctrl-C stops it)")
    try:
        threading.Event().wait()
    finally:
        handle.stop()
