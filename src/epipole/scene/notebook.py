"""Small tables and images that a notebook shows instead of a line of text (`_repr_html_`)."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np

from epipole.image import color_map
from epipole.image.encoding import encoded_image

WIDTH_PX = 480


def table_html(title: str, rows: Mapping[str, Any], image: np.ndarray | None = None) -> str:
    """A table of two columns under a title; below it an image.

    Args:
        title: what it is.
        rows: label and value; a value of None is left out.
        image: (h, w) of any range, shown in colors, or (h, w, 3) RGB of 8 bits.
    """
    lines = [
        f"<tr><td>{escape(label)}</td><td>{escape(str(value))}</td></tr>"
        for label, value in rows.items()
        if value is not None
    ]
    shown = "" if image is None or not image.size else _image_html(image)
    return f"<table><caption>{escape(title)}</caption>{''.join(lines)}</table>{shown}"


def _image_html(image: np.ndarray) -> str:
    step = max(1, image.shape[1] // WIDTH_PX)
    small = image[::step, ::step]
    rgb = small if small.ndim == 3 else color_map(small.astype(np.float32))
    data = b64encode(encoded_image(".png", rgb[..., ::-1])).decode("ascii")
    return f'<img alt="" src="data:image/png;base64,{data}">'
