"""Choice of a viewer's port."""

from __future__ import annotations

import errno
import socket

from epipole.errors import ConfigError

DEFAULT_PORT = 8080
_PORTS_TRIED = 100
_ALL_ADDRESSES = ("", "0.0.0.0", "::")


def port_for(host: str, port: int | None) -> int:
    """Check a given port; for None return `DEFAULT_PORT` or, if that is in use, the next free port.

    Raises:
        ConfigError: the port is in use or out of range, or the host is not an address of this machine.
    """
    return _free_port(host) if port is None else _usable_port(host, port)


def note_on_port(requested: int | None, shown: int) -> str:
    """A note about the port for the user; empty if it is the expected one."""
    if requested is not None or shown == DEFAULT_PORT:
        return ""
    return f"port {DEFAULT_PORT} is in use; using {shown}"


def is_local(host: str) -> bool:
    """Whether only this machine can reach a server at this host."""
    if host in _ALL_ADDRESSES:
        return False
    found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    return all(str(address[0]).startswith("127.") or address[0] == "::1" for *_, address in found)


def _usable_port(host: str, port: int) -> int:
    if not 0 < port < 65536:
        raise ConfigError(f"port must be between 1 and 65535, got {port}")
    problem = _problem_of(host, port)
    if problem is not None:
        raise ConfigError(f"port {port} {problem}")
    return port


def _free_port(host: str) -> int:
    for port in range(DEFAULT_PORT, DEFAULT_PORT + _PORTS_TRIED):
        if _problem_of(host, port) is None:
            return port
    raise ConfigError(
        f"ports {DEFAULT_PORT} to {DEFAULT_PORT + _PORTS_TRIED - 1} are all in use; pass another port"
    )


def _problem_of(host: str, port: int) -> str | None:
    """Why a server cannot listen there; checked here since the server would try other ports, or wait forever."""
    try:
        found = socket.getaddrinfo(
            host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE if not host else 0
        )
    except (OSError, UnicodeError) as error:
        raise ConfigError(f"unknown host {host!r}: {getattr(error, 'strerror', error)}") from error
    for family, kind, protocol, _, address in found:
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(address)
                probe.listen(1)
            except PermissionError:
                return "is reserved for the system"
            except OSError as error:
                if error.errno == errno.EADDRNOTAVAIL:
                    raise ConfigError(f"host {host!r} is not an address of this machine") from error
                return "is in use"
    return None
