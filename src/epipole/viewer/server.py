"""The server that viewers are shown on, without the words that it prints."""

from __future__ import annotations

import contextlib
import io

import viser

from epipole.errors import ConfigError, MissingDependencyError
from epipole.viewer.origin_check import origins_checked
from epipole.viewer.ports import is_local, port_for


def open_server(host: str, port: int | None) -> viser.ViserServer:
    """A server at that port; chosen as `port_for` does.

    It answers its own pages alone: see `origin_check`.

    Raises:
        ConfigError: the port is in use or out of range, or the host is no address of this machine.
        MissingDependencyError: the installed viser opens its server in another way than is known here, so that
            foreign web pages could not be kept out.
    """
    chosen = port_for(host, port)
    with _quiet(), origins_checked(is_local=is_local(host)) as opened:
        server = viser.ViserServer(host=host, port=chosen, label="epipole", verbose=False)
    if not opened.is_set():
        close_server(server)
        raise MissingDependencyError(
            f"viser {viser.__version__} cannot be kept from answering other web pages; install viser 1.1"
        )
    if server.get_port() != chosen:  # somebody took it in between
        close_server(server)
        raise ConfigError(f"port {chosen} is in use; give another one")
    return server


def close_server(server: viser.ViserServer) -> None:
    """Stop a server."""
    with _quiet():
        server.stop()


def _quiet() -> contextlib.AbstractContextManager[object]:
    """Hold back the server's banner and farewell, which it prints in any case."""
    return contextlib.redirect_stdout(io.StringIO())
