"""The lesson's pages as files, or from a small server on this machine."""

from __future__ import annotations

import errno
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from epipole._checks import as_path
from epipole._declared import checked
from epipole.errors import ConfigError
from epipole.io.atomic import atomic_write
from epipole.lesson.pages import lesson_pages

USUAL_PORT, PORTS_TRIED = 8070, 20


@dataclass(frozen=True, slots=True)
class ExportedLesson:
    """What `export_lesson` has written."""

    folder: Path
    pages: tuple[str, ...]
    """Names of the files; begin with `index.html`, or `index.zh.html` in Chinese."""
    num_bytes: int


@checked
def export_lesson(folder: str | Path) -> ExportedLesson:
    """Write the lesson's pages, each one file that loads nothing, in English and Chinese.

    Args:
        folder: where to; files of the same names are replaced, others stay.

    Raises:
        WorkspaceError: a page cannot be written.
    """
    place, pages, num_bytes = as_path(folder), lesson_pages(), 0
    for name, html in pages.items():
        data = html.encode("utf-8")
        with atomic_write(place / name) as part:
            part.write_bytes(data)
        num_bytes += len(data)
    return ExportedLesson(place, tuple(pages), num_bytes)


def open_lesson(host: str = "127.0.0.1", port: int | None = None) -> ThreadingHTTPServer:
    """A server of the pages, which holds them in memory and reads no file; `serve_forever` runs it.

    Args:
        host: the address to listen on.
        port: None: 8070, or the next free one.

    Raises:
        ConfigError: the port is in use or out of range, or the host is no address of this machine.
    """
    if port is not None and not 0 < port < 65536:
        raise ConfigError(f"port must be between 1 and 65535, got {port}")
    pages = {name: html.encode("utf-8") for name, html in lesson_pages().items()}
    for tried in range(USUAL_PORT, USUAL_PORT + PORTS_TRIED) if port is None else [port]:
        try:
            return ThreadingHTTPServer((host, tried), partial(_Pages, pages))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise ConfigError(f"cannot listen on {host}: {error.strerror or error}") from error
    raise ConfigError(f"port {port or USUAL_PORT} is in use; give another one")


class _Pages(BaseHTTPRequestHandler):
    """Answers with a page by its name, and with nothing else."""

    def __init__(self, pages: dict[str, bytes], *args: object) -> None:
        self.pages = pages
        super().__init__(*args)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        """A page; `/` is the index in the browser's language."""
        name = self.path.partition("?")[0].removeprefix("/")
        if not name:
            chinese = self.headers.get("Accept-Language", "").lower().startswith("zh")
            name = "index.zh.html" if chinese else "index.html"
        page = self.pages.get(name)
        if page is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(page)))
        self.end_headers()
        self.wfile.write(page)

    def log_message(self, *_: object) -> None:
        """Say nothing of what is asked for."""
