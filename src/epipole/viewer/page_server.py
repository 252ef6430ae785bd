"""A small server for pages in memory: it reads no files, and answers only requests from its own pages."""

from __future__ import annotations

import socket
import sys
import threading
from collections.abc import Callable, Generator, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from email.message import Message
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from epipole.errors import ConfigError
from epipole.viewer.allowed import is_allowed
from epipole.viewer.ports import is_local

HTML, BYTES, JPEG = "text/html; charset=utf-8", "application/octet-stream", "image/jpeg"
EVENTS = "text/event-stream"
OWN_SITE = (None, "same-origin", "none")
"""Allowed origins of a browser's request (`Sec-Fetch-Site`): the page itself, the address bar, or a program other than
a browser."""


@dataclass(frozen=True, slots=True, eq=False)
class Request:
    """An HTTP request."""

    headers: Message
    query: str
    """The part of its address after the question mark."""


@dataclass(frozen=True, slots=True, eq=False)
class Served:
    """The content at an address."""

    kind: str
    """Its media type."""
    make: Callable[[Request], bytes | Generator[bytes, None, None] | None]
    """Makes the bytes, or returns None if there are none. A generator's bytes are streamed until the tab closes."""


def fixed(kind: str, data: bytes) -> Served:
    """The same bytes for every request."""
    return Served(kind, lambda _: data)


class PageServer:
    """Serves pages by address, in background threads, until it is stopped."""

    def __init__(self, pages: Mapping[str, Served], host: str, port: int) -> None:
        """Start listening.

        Args:
            pages: by address, without the leading slash; "" is the start page.
            host: the address to listen on.
            port: as chosen by `port_for`.

        Raises:
            ConfigError: the port has been taken in the meantime.
        """
        pages = {"favicon.ico": fixed("image/x-icon", b""), **pages}  # browsers request it
        try:
            self.http = _Server((host, port), partial(_Answer, pages, is_local(host)))
        except OSError as error:
            raise ConfigError(f"cannot listen on {host}, port {port}: {error.strerror or error}") from error
        self.http.daemon_threads = True
        self.port = int(self.http.server_address[1])
        self.stopped = threading.Event()
        self.thread = threading.Thread(target=self.http.serve_forever, name="epipole-pages", daemon=True)
        self.thread.start()

    def stop(self) -> None:
        """Close the server; further calls do nothing."""
        if not self.stopped.is_set():
            self.stopped.set()
            self.http.shutdown()
            self.http.server_close()
            self.http.close_connections()


class _Server(ThreadingHTTPServer):
    def __init__(self, *args: Any) -> None:
        self.connections = set[socket.socket]()
        super().__init__(*args)

    def process_request(self, request: Any, client_address: Any) -> None:
        self.connections.add(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        self.connections.discard(request)
        super().shutdown_request(request)

    def close_connections(self) -> None:
        """Close connections that browsers keep open, so that a new server at this address gets their next requests."""
        for connection in self.connections.copy():
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore errors from a closed tab or an idle connection."""
        if not isinstance(sys.exception(), (ConnectionError, TimeoutError)):
            super().handle_error(request, client_address)


class _Answer(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = 60

    def __init__(self, pages: Mapping[str, Served], local: bool, *args: object) -> None:
        self.pages, self.local = pages, local
        super().__init__(*args)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        hosts, origins = (self.headers.get_all(name, []) for name in ("Host", "Origin"))
        is_own = is_allowed(hosts, origins, is_local=self.local) and not self._is_embedded()
        if not is_own:
            self.send_error(HTTPStatus.FORBIDDEN, "This viewer only answers requests from its own page")
            return
        address, _, query = self.path.removeprefix("/").partition("?")
        served = self.pages.get(address)
        data = served.make(Request(self.headers, query)) if served is not None else None
        if served is None or data is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", served.kind)
        if isinstance(data, bytes):
            self.send_header("Content-Length", str(len(data)))
        else:
            self.send_header("Connection", "close")
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        if isinstance(data, bytes):
            self.wfile.write(data)
            return
        with closing(data):
            for piece in data:
                self.wfile.write(piece)

    def _is_embedded(self) -> bool:
        """Whether another web page requests it as an image, a frame or a script; only links are allowed."""
        site, kind = (self.headers.get(f"Sec-Fetch-{name}") for name in ("Site", "Dest"))
        return site not in OWN_SITE and kind != "document"

    def log_message(self, *_: object) -> None:
        """Log nothing."""
