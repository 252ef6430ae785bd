"""A reconstruction in the browser: points, cameras with their pictures, and a few sliders."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from epipole.scene import Reconstruction

LoadImage = Callable[[str], UInt8[np.ndarray, "h w 3"] | None]


@dataclass(frozen=True, slots=True, eq=False)
class ViewerHandle:
    """A running viewer."""

    url: str
    stop: Callable[[], None]
    """Close the viewer; calling it again does nothing."""


def view(
    reconstruction: Reconstruction,
    load_image: LoadImage,
    *,
    port: int = 8080,
    host: str = "127.0.0.1",
    block: bool = True,
) -> ViewerHandle:
    """Show a reconstruction in the browser.

    Args:
        reconstruction: the model, upright (+z is up).
        load_image: gives the RGB picture of an image name, or None where there is none; called in a thread of
            its own, one picture after another, after the viewer has started.
        port: where to listen; the next free port is taken if this one is in use.
        host: the address to listen on; "0.0.0.0" lets other machines in.
        block: return only when the user interrupts with Ctrl-C, and stop the viewer then.

    Returns:
        The address to open, and the way to stop.
    """
    from epipole.viewer.room import Room, open_server  # viser is slow to import, and few runs end in a viewer

    server = open_server(host, port)
    room = Room(server, reconstruction)
    room.start_loading(load_image)
    return serve(room, server.get_port(), host, block=block)


@runtime_checkable
class Stoppable(Protocol):
    """What is being served."""

    stopped: threading.Event

    def stop(self) -> None:
        """Close the server."""


def serve(room: Stoppable, port: int, host: str, *, block: bool) -> ViewerHandle:
    """The handle of a room that is open; with `block` only after Ctrl-C."""
    shown_host = "127.0.0.1" if host in ("", "0.0.0.0") else host
    handle = ViewerHandle(f"http://{shown_host}:{port}", room.stop)
    if block:
        try:
            room.stopped.wait()
        except KeyboardInterrupt:
            room.stop()
    return handle
