"""A viewer that is open while a job runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from epipole.screen import open_console
from epipole.viewer.handle import Stoppable, serve
from epipole.viewer.ports import note_on_port

if TYPE_CHECKING:
    import viser

V = TypeVar("V", bound=Stoppable)


@contextmanager
def opened_live(viewer_on: Callable[[viser.ViserServer], V], host: str, port: int | None) -> Iterator[V]:
    """A viewer on a server of its own, whose address is printed; it is closed with the block.

    Raises:
        ConfigError: the port is in use or out of range, or the host is no address of this machine.
    """
    # viser is slow to import, and few jobs are watched.
    from epipole.viewer.server import open_server

    server = open_server(host, port)
    shown = server.get_port()
    viewer = viewer_on(server)
    handle = serve(viewer, shown, host, note_on_port(port, shown), block=False)
    noted = f" ({handle.note})" if handle.note else ""
    open_console(stderr=True).print(f"Live view at {handle.url}{noted}", highlight=False)
    try:
        yield viewer
    finally:
        handle.stop()
