"""The newest state of a job, announced to every open tab by server-sent events."""

from __future__ import annotations

import json
import secrets
import threading
from collections.abc import Callable, Generator, Mapping
from time import perf_counter
from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole.report.space import space_data
from epipole.report.space_scene import SpaceScene
from epipole.viewer.page_server import BYTES, EVENTS, JPEG, Served

MOST_STREAMS = 4
"""Tabs with an open event stream. Browsers open six connections to a server, so two stay free for data. The tab that
has been connected longest is disconnected for a newer one, and reconnects automatically."""
RECONNECT_MS, HEARTBEAT_S = 1000, 10.0
"""How long a tab waits before it reconnects, and how often an idle stream checks that its tab is still open."""
END_S = 3.0
"""Longest wait at the end of a job for tabs to fetch the final state."""
MOST_POINTS = 100_000
"""Limit per layer: 1.6 MB."""


class LiveStream:
    """The newest state of a job, and its data, created when a tab first requests them.

    Each state replaces the previous one, so a slow or stuck tab misses states and delays nothing.
    """

    def __init__(self) -> None:
        self.run_id = secrets.token_hex(8)
        """Lets a page detect that another job now uses its address."""
        self._changed = threading.Condition()
        self._number, self._num_final = 0, 0
        self._state: dict[str, Any] = {"run": self.run_id, "state": "Starting", "parts": {}}
        self._parts: dict[str, _Part] = {}
        self._streams: list[object] = []

    @property
    def is_watched(self) -> bool:
        """Whether a tab is connected."""
        return bool(self._streams)

    def publish(self, state: Mapping[str, Any], **parts: Callable[[], bytes]) -> None:
        """Announce a new state.

        Args:
            state: small JSON values for the page; values under other names stay unchanged.
            parts: functions that make the bytes of `scene` or `image`, called in a server thread if a tab requests
                them.
        """
        with self._changed:
            self._number += 1
            self._parts |= {name: _Part(make) for name, make in parts.items()}
            numbers = {**self._state["parts"], **dict.fromkeys(parts, self._number)}
            self._state = {**self._state, **state, "parts": numbers}
            self._changed.notify_all()

    def end(self, words: str, meanwhile: Callable[[], object]) -> None:
        """Announce the end, and wait until all tabs have fetched the final state, at most `END_S` seconds.

        Args:
            words: how the job ended.
            meanwhile: called repeatedly while tabs fetch.
        """
        self.publish({"ended": words})
        stop = perf_counter() + END_S
        while self._num_final < len(self._streams) and perf_counter() < stop:
            meanwhile()
            with self._changed:
                self._changed.wait(0.02)
        with self._changed:
            self._streams.clear()
            self._changed.notify_all()

    def pages(self) -> dict[str, Served]:
        """The addresses that the page fetches from."""
        return {
            "live/events": Served(EVENTS, lambda _: self.events()),
            "live/scene": Served(BYTES, lambda _: self._bytes_of("scene")),
            "live/image": Served(JPEG, lambda _: self._bytes_of("image")),
            "live/final": Served(BYTES, lambda _: self._note_final()),
        }

    def events(self) -> Generator[bytes, None, None]:
        """Server-sent events: the current state, then every change that this reader is fast enough for."""
        stream, sent = object(), -1
        with self._changed:
            self._streams = [*self._streams, stream][-MOST_STREAMS:]
            self._changed.notify_all()
        try:
            yield f"retry: {RECONNECT_MS}\n\n".encode()
            while True:
                with self._changed:
                    if self._number == sent and stream in self._streams:
                        self._changed.wait(HEARTBEAT_S)
                    if stream not in self._streams:
                        return
                    state, is_new, sent = self._state, self._number > sent, self._number
                yield f"data: {json.dumps(state)}\n\n".encode() if is_new else b":\n\n"
        finally:
            with self._changed:
                self._streams = [other for other in self._streams if other is not stream]

    def _bytes_of(self, name: str) -> bytes | None:
        part = self._parts.get(name)
        return None if part is None else part.data()

    def _note_final(self) -> bytes:
        with self._changed:
            self._num_final += 1
            self._changed.notify_all()
        return b""


class _Part:
    """Bytes created once, on the first request."""

    def __init__(self, make: Callable[[], bytes]) -> None:
        self._make, self._lock, self._data = make, threading.Lock(), b""

    def data(self) -> bytes:
        with self._lock:
            self._data = self._data or self._make()
            return self._data


def scene_bytes(scene: SpaceScene, origin_in_world: Float64[np.ndarray, " 3"]) -> bytes:
    """A scene as one message: the length of its numbers (4 bytes), the numbers as JSON, and the blocks in order."""
    data = space_data(scene, MOST_POINTS, origin_in_world=origin_in_world)
    data.numbers["lengths"] = [len(block) for block in data.blocks.values()]
    numbers = json.dumps(data.numbers, allow_nan=False).encode()
    return b"".join([len(numbers).to_bytes(4, "little"), numbers, *data.blocks.values()])
