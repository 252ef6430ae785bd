"""viser's server with the check of `allowed`."""

from __future__ import annotations

import http
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from epipole.viewer.allowed import is_allowed

_PACKAGE = "viser."
_one_at_a_time = threading.Lock()


@contextmanager
def origins_checked(*, is_local: bool) -> Iterator[threading.Event]:
    """A server that viser opens in this block turns away requests that are not allowed, with 403.

    viser hands no hook on to `websockets.asyncio.server.serve`, whose `process_request` is the documented place
    for this: `serve` is wrapped as long as the block lasts, for viser's calls alone.

    Yields:
        An event that is set once a server was opened with the check. If it is not set after the block, viser
        has changed, and its server must not be used.
    """
    serve = websockets.asyncio.server.serve
    opened = threading.Event()

    def checked_serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        if str(getattr(process_request, "__module__", "")).startswith(_PACKAGE):
            process_request = _with_check(process_request, is_local=is_local)
            opened.set()
        return serve(*arguments, process_request=process_request, **options)

    with _one_at_a_time:
        websockets.asyncio.server.serve = checked_serve  # type: ignore[misc,assignment]
        try:
            yield opened
        finally:
            websockets.asyncio.server.serve = serve  # type: ignore[misc]


def _with_check(
    process_request: Callable[[ServerConnection, Request], Any], *, is_local: bool
) -> Callable[[ServerConnection, Request], Any]:
    def check(connection: ServerConnection, request: Request) -> Any:
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        if is_allowed(hosts, origins, is_local=is_local):
            return process_request(connection, request)
        body = b"This viewer answers its own page alone.\n"
        headers = Headers({"Content-Type": "text/plain", "Content-Length": str(len(body))})
        return Response(http.HTTPStatus.FORBIDDEN.value, "Forbidden", headers, body)

    return check
