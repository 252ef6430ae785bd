"""Handle of a running viewer."""

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
    """Close the viewer; further calls do nothing."""
    note: str = ""
    """A note for the user, such as that another port than the default is used."""

    def __repr__(self) -> str:
        return f"ViewerHandle({self.url})"


@runtime_checkable
class Stoppable(Protocol):
    """An object shown by a server."""

    stopped: threading.Event

    def stop(self) -> None:
        """Close the server."""


def serve(viewer: Stoppable, port: int, host: str, note: str, *, block: bool) -> ViewerHandle:
    """The handle of an open viewer; with `block`, returns after Ctrl-C."""
    shown_host = "127.0.0.1" if host in ("", "0.0.0.0", "::") else host
    shown_host = f"[{shown_host}]" if ":" in shown_host else shown_host
    handle = ViewerHandle(f"http://{shown_host}:{port}", viewer.stop, note)
    if block:
        try:
            viewer.stopped.wait()
        except KeyboardInterrupt:
            viewer.stop()
    return handle
