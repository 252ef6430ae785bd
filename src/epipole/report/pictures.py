"""The table of pictures: thumbnails with the features that see points, numbers, and reasons in words."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from PIL import Image, UnidentifiedImageError

from epipole.report.content import ImageRow, ReportContent
from epipole.report.markup import count, data_uri, escape, number

MAX_FEATURES = 400
"""Features drawn on one thumbnail."""


def draw_pictures(content: ReportContent) -> str:
    """A sortable table, one row per picture; those without a place come first."""
    with_models = bool(content.other_components)
    heads = [("", ""), ("Picture", "text"), *([("Model", "number")] if with_models else [])]
    heads += [("Keypoints", "number"), ("Observations", "number"), ("Used", "number"), ("Error", "number")]
    heads += [("State", "text")]
    header = "".join(
        f'<th scope="col" data-sort="{kind}"><button type="button">{text}</button></th>'
        if kind
        else "<th></th>"
        for text, kind in heads
    )
    rows = sorted(content.image_rows, key=lambda row: row.is_registered)
    body = "".join(_row(row, content, with_models) for row in rows)
    return f'<table class="pictures sortable"><thead><tr>{header}</tr></thead><tbody>{body}</tbody></table>'


def _row(row: ImageRow, content: ReportContent, with_models: bool) -> str:
    used = row.num_observations / row.num_keypoints if row.num_keypoints else math.nan
    model = "\N{EN DASH}" if row.component < 0 else str(row.component + 1)
    state = "placed" if row.is_registered else f"not placed: {escape(row.reason or 'reason not recorded')}"
    cells = [
        f'<td class="thumb">{_thumbnail(row.name, content.thumbnails, content.inliers)}</td>',
        f'<th scope="row" class="name">{escape(row.name)}</th>',
        *([_cell(row.component, model)] if with_models else []),
        _cell(row.num_keypoints, count(row.num_keypoints)),
        _cell(row.num_observations, count(row.num_observations)),
        _cell(used, f"{100 * used:.0f} %" if math.isfinite(used) else "\N{EN DASH}"),
        _cell(
            row.mean_error_px, number(row.mean_error_px) + (" px" if math.isfinite(row.mean_error_px) else "")
        ),
        f'<td class="state">{state}</td>',
    ]
    kind = "" if row.is_registered else ' class="absent"'
    return f"<tr{kind}>{''.join(cells)}</tr>"


def _cell(value: int | float, text: str) -> str:
    key = f"{value:.6g}" if math.isfinite(value) else ""
    return f'<td class="num" data-key="{key}">{text}</td>'


def _thumbnail(
    name: str, thumbnails: Mapping[str, bytes], inliers: Mapping[str, Float[np.ndarray, "k 2"]]
) -> str:
    data = thumbnails.get(name)
    size = _jpeg_size(data) if data else None
    if data is None or size is None:
        return ""
    width, height = size
    dots = _dots(inliers[name], width, height) if name in inliers else ""
    picture = f'<image width="{width}" height="{height}" href="{data_uri(data, "image/jpeg")}"/>'
    marks = f'<path class="halo" d="{dots}"/><path class="dots" d="{dots}"/>' if dots else ""
    return (
        '<button type="button" class="zoom" aria-label="enlarge">'
        f'<svg viewBox="0 0 {width} {height}">{picture}{marks}</svg></button>'
    )


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    try:
        with Image.open(io.BytesIO(data)) as image:
            return image.size if image.format == "JPEG" else None
    except (UnidentifiedImageError, OSError):
        return None


def _dots(fractions: Float[np.ndarray, "k 2"], width: int, height: int) -> str:
    """Zero-length strokes, which round caps turn into discs: far shorter than one circle element each."""
    inside = fractions[((fractions >= 0) & (fractions <= 1)).all(axis=1)]
    chosen = inside[np.linspace(0, len(inside) - 1, min(len(inside), MAX_FEATURES)).astype(int)]
    return "".join(f"M{x:.1f} {y:.1f}h0" for x, y in chosen * (width, height))
