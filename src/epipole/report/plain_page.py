"""A page without scripts: pictures, tables and charts in one file."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

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


def color_map(values: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Turbo colours from the 1st to the 99th percentile; black where unknown."""
    known = np.isfinite(values)
    low, high = _bounds(values)
    scaled = np.where(known, (values - low) / max(high - low, 1e-12), 0.0)
    rgb = cv2.applyColorMap((255 * np.clip(scaled, 0, 1)).astype(np.uint8), cv2.COLORMAP_TURBO)[
        ..., ::-1
    ].copy()
    rgb[~known] = 0
    return np.asarray(rgb, np.uint8)


def _bounds(values: np.ndarray) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, (1, 99))
    return float(low), float(high)


def span(values: np.ndarray) -> str:
    """The ends of the colour map in words."""
    low, high = _bounds(values)
    return f"{low:.3g} (blue) to {high:.3g} (red)"


def picture_uri(rgb: np.ndarray) -> str:
    """The picture, reduced, as a data URI."""
    scale = min(1.0, _SHOWN_PX / max(rgb.shape[:2]))
    if scale < 1:
        size = (max(1, round(rgb.shape[1] * scale)), max(1, round(rgb.shape[0] * scale)))
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".png", np.ascontiguousarray(rgb[..., ::-1]))
    return data_uri(data.tobytes(), "image/png")


def figure(caption: str, source: str) -> str:
    """A picture under its caption."""
    return f'<figure><figcaption class="soft">{escape(caption)}</figcaption><img src="{source}" alt="{escape(caption)}"></figure>'


def section(title: str, content: str) -> str:
    """A part of the page under its title."""
    return f"<section><h2>{title}</h2>{content}</section>"
