"""Text for a terminal: names of files and what they hold cannot move its cursor, color it, or reorder its letters."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Callable, Iterator
from contextvars import ContextVar

_ACTING = re.compile(
    "["
    "\x00-\x08\x0b-\x1f\x7f-\x9f"  # C0 but tab and line feed, DEL, C1: escape sequences begin with one
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # direction of writing
    "\u200b\u2028\u2029\u2060\ufeff\U000e0000-\U000e007f"  # invisible, or line breaks for some
    "\ud800-\udfff"  # bytes that are no UTF-8, as file names may hold
    "]"
)
_BREAKS = re.compile(r"[\t\n]")
_WORDING: ContextVar[Callable[[str], str] | None] = ContextVar("wording", default=None)


def terminal_text(text: str) -> str:
    r"""The text with everything that a terminal acts on written out, as `\x1b`; tabs and line feeds stay."""
    return _ACTING.sub(_written_out, text)


def one_line(text: str) -> str:
    r"""The same without tabs and line feeds, which a name may hold to look like a message of ours."""
    return _BREAKS.sub(_written_out, terminal_text(text))


def say(text: str, *, to_stderr: bool = False) -> None:
    """Print a line, and flush it."""
    print(terminal_text(text), file=sys.stderr if to_stderr else sys.stdout, flush=True)


@contextlib.contextmanager
def wording(as_options: Callable[[str], str]) -> Iterator[None]:
    """Print warnings with the words of the command line: `--max-side-px` for `max_side_px`.

    Args:
        as_options: message with config fields -> the same with options.
    """
    before = _WORDING.set(as_options)
    try:
        yield
    finally:
        _WORDING.reset(before)


def in_words_of_caller(message: str) -> str:
    """A warning with the names of options if a command prints it, otherwise unchanged."""
    as_options = _WORDING.get()
    return message if as_options is None else as_options(message)


def _written_out(found: re.Match[str]) -> str:
    return (
        found[0].encode("ascii", "backslashreplace").decode()
        if ord(found[0]) > 0x7F
        else repr(found[0])[1:-1]
    )
