"""The server that viewers are shown on, without the words that it prints."""

from __future__ import annotations

import contextlib
import io

import viser


def open_server(host: str, port: int) -> viser.ViserServer:
    """A server at that port, or at the next free one."""
    with _quiet():
        return viser.ViserServer(host=host, port=port, label="epipole", verbose=False)


def close_server(server: viser.ViserServer) -> None:
    """Stop a server."""
    with _quiet():
        server.stop()


def _quiet() -> contextlib.AbstractContextManager[object]:
    """Hold back the server's banner and farewell, which it prints in any case."""
    return contextlib.redirect_stdout(io.StringIO())
