"""Handling of Ctrl-C in work that must stop between two steps, not within one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def graceful_interrupt() -> Iterator[Callable[[], bool]]:
    """Yield a function that says whether Ctrl-C was pressed in the block; a second Ctrl-C interrupts as usual.

    Does nothing outside the main thread, and where Python's default Ctrl-C handler is not installed.
    """
    pressed = threading.Event()
    usual = signal.getsignal(signal.SIGINT)

    def heed(number: int, at: FrameType | None) -> None:
        if pressed.is_set() and callable(usual):
            usual(number, at)
        pressed.set()

    is_ours = threading.current_thread() is threading.main_thread() and usual is signal.default_int_handler
    if is_ours:
        signal.signal(signal.SIGINT, heed)
    try:
        yield pressed.is_set
    finally:
        if is_ours:
            signal.signal(signal.SIGINT, usual)
