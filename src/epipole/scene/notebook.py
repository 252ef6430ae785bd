"""Small HTML tables and images for notebooks (`_repr_html_`)."""

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
    """A table of two columns with a title, above an image.

    Args:
        title: caption of the table.
        rows: labels and values; None values are skipped.
        image: (h, w) of any range, shown with a color map, or (h, w, 3) 8-bit RGB.
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
