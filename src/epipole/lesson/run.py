"""The lesson's pages as files, or served on this machine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from epipole._checks import as_path, checked
from epipole.lesson.pages import lesson_pages
from epipole.runs import refuse_existing, replacing_file
from epipole.viewer.handle import ViewerHandle, serve
from epipole.viewer.page_server import HTML, PageServer, Served, fixed
from epipole.viewer.ports import note_on_port, port_for


@dataclass(frozen=True, slots=True)
class ExportedLesson:
    """Result of `export_lesson`."""

    folder: Path
    pages: tuple[str, ...]
    """File names; start with `index.html`, or with `index.zh.html` in Chinese."""
    num_bytes: int


@checked
def export_lesson(folder: str | Path) -> ExportedLesson:
    """Write the lesson as self-contained pages in English and Chinese.

    Args:
        folder: output folder; pages written by an earlier call are replaced, other files stay.

    Raises:
        WorkspaceError: a file with a page's name was not written by an earlier call, or a page cannot be written.
    """
    position, pages, num_bytes = as_path(folder), lesson_pages(), 0
    refuse_existing([position / name for name in pages], "lesson", ())
    for name, html in pages.items():
        data = html.encode("utf-8")
        with replacing_file(position / name, "lesson", ()) as part:
            part.write_bytes(data)
        num_bytes += (position / name).stat().st_size
    return ExportedLesson(position, tuple(pages), num_bytes)


def open_lesson(host: str = "127.0.0.1", port: int | None = None) -> ViewerHandle:
    """Serve the pages from memory until the server is stopped.

    Args:
        host: the address to listen on.
        port: the port to listen on; None: 8080, or the next free one.

    Raises:
        ConfigError: the port is in use or out of range, or the host is not an address of this machine.
    """
    chosen = port_for(host, port)
    made = {name: html.encode("utf-8") for name, html in lesson_pages().items()}
    pages = {name: fixed(HTML, data) for name, data in made.items()}
    pages[""] = Served(
        HTML, lambda requested: made[_index_for(str(requested.headers.get("Accept-Language", "")))]
    )
    server = PageServer(pages, host, chosen)
    return serve(server, server.port, host, note_on_port(port, server.port), block=False)


def _index_for(languages: str) -> str:
    return "index.zh.html" if languages.lower().startswith("zh") else "index.html"
