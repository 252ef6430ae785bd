"""A page without scripts: pictures, tables and charts in one file."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from epipole.image import color_range, downscaled
from epipole.report.frame import joined
from epipole.report.markup import data_uri, escape

_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_SHOWN_PX = 1000  # longest side of the pictures in the page


def plain_page(title: str, body: str, version: str) -> str:
    """The whole page; the body is HTML already."""
    footer = f"<footer>Made by epipole {escape(version)}. This page is one file and loads nothing.</footer>"
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{joined(('page.css', 'figures.css'))}</style>"
        f"</head>\n<body><main>{body}{footer}</main></body></html>\n"
    )


def notes_list(warnings: Sequence[str]) -> str:
    """Warnings under each other; nothing where there are none."""
    items = "".join(f'<li class="warn">{escape(w)}</li>' for w in warnings)
    return f'<ul class="notes">{items}</ul>' if items else ""


def span(values: np.ndarray) -> str:
    """The ends of the colour map in words."""
    low, high = color_range(values)
    return f"{low:.3g} (blue) to {high:.3g} (red)"


def picture_uri(rgb: np.ndarray) -> str:
    """The picture, reduced, as a data URI."""
    small = downscaled(rgb, _SHOWN_PX)
    _, data = cv2.imencode(".png", np.ascontiguousarray(small[..., ::-1]))
    return data_uri(data.tobytes(), "image/png")


def figure(caption: str, source: str) -> str:
    """A picture under its caption."""
    return f'<figure><figcaption class="soft">{escape(caption)}</figcaption><img src="{source}" alt="{escape(caption)}"></figure>'


def section(title: str, content: str) -> str:
    """A part of the page under its title."""
    return f"<section><h2>{title}</h2>{content}</section>"
