"""Safe pieces of HTML: escaped text, embedded data, formatted numbers."""

from __future__ import annotations

import base64
import json
import math
import re
from typing import Any

import markupsafe
from markupsafe import Markup

_BIDI_CONTROLS = "\u202a-\u202e\u2066-\u2069"
"""Characters that change the direction of the text after them and so disguise names."""
_UNPRINTABLE = re.compile(f"[\x00-\x08\x0b-\x1f\x7f\ud800-\udfff{_BIDI_CONTROLS}]")
_BIDI_CONTROLS_IN_JSON = re.compile(r"\\u(202[a-e]|206[6-9])")


def escape(value: object) -> Markup:
    """Escape text for HTML content and quoted attributes; `Markup` stays markup.

    Characters not allowed in HTML (control characters, lone surrogates) and those that change the direction of text
    become U+FFFD in both cases.
    """
    return Markup(_UNPRINTABLE.sub("\N{REPLACEMENT CHARACTER}", markupsafe.escape(value)))


def data_uri(data: bytes, media_type: str) -> str:
    """Bytes as a data URI."""
    return f"data:{media_type};base64,{base64.b64encode(data).decode('ascii')}"


def json_block(element_id: str, data: Any) -> Markup:
    """Data for the page's script. `<` is escaped, so that no name can end the element."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    text = _BIDI_CONTROLS_IN_JSON.sub(r"\\ufffd", text)
    text = text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
    return Markup(f'<script type="application/json" id="{escape(element_id)}">{text}</script>')


def bytes_block(element_id: str, data: bytes) -> Markup:
    """Bytes for the page's script, in an element that browsers neither run nor show."""
    text = base64.b64encode(data).decode("ascii")
    return Markup(f'<script type="application/octet-stream" id="{escape(element_id)}">{text}</script>')


def count(value: int) -> str:
    """An integer with thousands separators."""
    return f"{value:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def sentence(text: str) -> str:
    """A message as a sentence of a page: with a capital letter, unless it starts with a file or an option, and with a ± sign."""
    first = text.split(" ", 1)[0].rstrip(",:;")
    start = text[:1].upper() if first.isalpha() else text[:1]
    return start + text[1:].replace(" +- ", " \N{PLUS-MINUS SIGN} ")  # with spaces, so not in names of files


def plural(value: int, singular: str, many: str | None = None) -> str:
    """A count and its noun: "1 image", "4 images"."""
    return f"{count(value)} {singular if value == 1 else many or singular + 's'}"


def axis_words(*, is_enu: bool) -> tuple[str, str, str]:
    """Names of the world's axes, with their directions if these are east, north and up."""
    return ("x, east", "y, north", "z, up") if is_enu else ("x", "y", "z")


def number(value: float, digits: int = 2) -> str:
    """A measured number, or a dash if it is not finite."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "\N{EN DASH}"


def seconds(value: float) -> str:
    """A duration in readable units."""
    if not math.isfinite(value):
        return "\N{EN DASH}"
    if value < 60:
        return f"{value:.1f} s" if value >= 0.95 else f"{value:.2f} s"
    minutes, rest = divmod(round(value), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"
