"""`epipole lesson`."""

from __future__ import annotations

from pathlib import Path

from epipole._terminal import say


def lesson(export: Path | None = None, port: int | None = None, host: str = "127.0.0.1") -> None:
    """Open the lesson on 3D vision in the browser; or write its pages as files.

    Args:
        export: Write the pages to this folder instead, in English and Chinese; they need no server.
        port: The port to listen on; None: 8080, or the next free one if it is in use.
        host: The address to listen on; 0.0.0.0 allows connections from other machines.
    """
    import threading

    from epipole.lesson.run import export_lesson, open_lesson

    if export is not None:
        done = export_lesson(export)
        say(f"Written {len(done.pages)} pages ({done.num_bytes / 1e6:.1f} MB): {done.folder / 'index.html'}")
        return
    handle = open_lesson(host, port)
    noted = f"; {handle.note}" if handle.note else ""
    say(f"Lesson at {handle.url} (Ctrl-C stops it{noted})")
    try:
        threading.Event().wait()
    finally:
        handle.stop()
