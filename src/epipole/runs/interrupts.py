"""Ctrl-C where work must end between two steps, not within one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def graceful_interrupt() -> Iterator[Callable[[], bool]]:
    """Whether Ctrl-C was pressed in the block; pressed again it interrupts as usual.

    Outside of the main thread, and where Ctrl-C is not Python's own, it stays as it is.
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
