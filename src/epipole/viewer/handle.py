"""A running viewer, as its caller sees it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable


@dataclass(frozen=True, slots=True, eq=False)
class ViewerHandle:
    """A running viewer."""

    url: str
    stop: Callable[[], None]
    """Close the viewer; calling it again does nothing."""
    note: str = ""
    """What the user should know: that another port was taken than the usual one."""

    def __repr__(self) -> str:
        return f"ViewerHandle({self.url})"


@runtime_checkable
class Stoppable(Protocol):
    """What is being shown on a server."""

    stopped: threading.Event

    def stop(self) -> None:
        """Close the server."""


def serve(viewer: Stoppable, port: int, host: str, note: str, *, block: bool) -> ViewerHandle:
    """The handle of a viewer that is open; with `block` only after Ctrl-C."""
    shown_host = "127.0.0.1" if host in ("", "0.0.0.0", "::") else host
    shown_host = f"[{shown_host}]" if ":" in shown_host else shown_host
    handle = ViewerHandle(f"http://{shown_host}:{port}", viewer.stop, note)
    if block:
        try:
            viewer.stopped.wait()
        except KeyboardInterrupt:
            viewer.stop()
    return handle
