"""The page of a stereo pair: pictures, disparities, what is not known and why, error against range."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from epipole.report._style import STYLE
from epipole.report.charts import draw_histogram, histogram_of
from epipole.report.markup import data_uri, escape, number
from epipole.stereo import DepthMap, DisparityMap, RectifiedRig, StereoReason

_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_FIGURES = (
    ".figures{display:grid;grid-template-columns:repeat(auto-fit,minmax(22rem,1fr));gap:1rem}"
    "figure{margin:0}figure img{width:100%}"
)
_SHOWN_PX = 1000  # longest side of the pictures in the page
_REASONS = {
    StereoReason.OK: "known",
    StereoReason.OCCLUDED: "the other picture does not confirm it (hidden there, or mistaken)",
    StereoReason.OUT_OF_VIEW: "its match lies beyond the other picture",
    StereoReason.AMBIGUOUS: "another disparity fits nearly as well",
    StereoReason.SPECKLE: "it stands alone among others",
    StereoReason.TEXTURELESS: "nothing around it changes along the row",
}
_NEAREST, _FARTHEST = 8.0, 800.0  # baselines: ranges in the table


@dataclass(frozen=True, slots=True, eq=False)
class StereoPage:
    """What the page shows."""

    left_rgb: UInt8[np.ndarray, "h w 3"]
    right_rgb: UInt8[np.ndarray, "h w 3"]
    disparities: DisparityMap
    reason_colors: UInt8[np.ndarray, "k 3"]
    """Of the values of `StereoReason`."""
    depths: DepthMap | None
    rig: RectifiedRig | None
    version: str


def render_stereo_page(page: StereoPage) -> str:
    """One HTML page with everything inside it."""
    found = page.disparities
    known = np.isfinite(found.disparity_px)
    pictures = [
        ("left", _shown(page.left_rgb)),
        ("right", _shown(page.right_rgb)),
        (f"disparity, {_span(found.disparity_px)} px", _shown(color_map(found.disparity_px))),
        (f"its standard deviation, {_span(found.sigma_px)} px", _shown(color_map(found.sigma_px))),
        ("what is not known, and why", _shown(page.reason_colors[found.reason])),
    ]
    if page.depths is not None:
        pictures.append((f"depth, {_span(page.depths.depth)}", _shown(color_map(page.depths.depth))))
    histograms = [
        draw_histogram(histogram_of(found.disparity_px[known], "disparity, px")),
        draw_histogram(histogram_of(found.sigma_px[known], "standard deviation of disparity, px")),
    ]
    body = "".join(
        (
            f"<h1>Stereo pair: {100 * found.density:.1f} % of the left picture's pixels known</h1>",
            _section(
                "Pictures", f'<div class="figures">{"".join(_figure(*picture) for picture in pictures)}</div>'
            ),
            _section("What is known", _reasons(page)),
            _section("Values", f'<div class="two">{"".join(histograms)}</div>'),
            _ranges(page) if page.rig is not None else "",
            f"<footer>Made by epipole {escape(page.version)}. This page is one file and loads nothing.</footer>",
        )
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Stereo pair</title><style>{STYLE}{_FIGURES}</style>"
        f"</head>\n<body><main>{body}</main></body></html>\n"
    )


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


def _span(values: np.ndarray) -> str:
    low, high = _bounds(values)
    return f"{low:.3g} (blue) to {high:.3g} (red)"


def _shown(rgb: np.ndarray) -> str:
    """The picture, reduced, as a data URI."""
    scale = min(1.0, _SHOWN_PX / max(rgb.shape[:2]))
    if scale < 1:
        size = (max(1, round(rgb.shape[1] * scale)), max(1, round(rgb.shape[0] * scale)))
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".png", np.ascontiguousarray(rgb[..., ::-1]))
    return data_uri(data.tobytes(), "image/png")


def _figure(caption: str, source: str) -> str:
    return f'<figure><figcaption class="soft">{escape(caption)}</figcaption><img src="{source}" alt="{escape(caption)}"></figure>'


def _section(title: str, content: str) -> str:
    return f"<section><h2>{title}</h2>{content}</section>"


def _reasons(page: StereoPage) -> str:
    counts = np.bincount(page.disparities.reason.ravel(), minlength=len(StereoReason))
    rows = "".join(
        f'<tr><td style="background:rgb({red},{green},{blue})">&emsp;</td><td>{words}</td>'
        f"<td>{100 * counts[reason] / counts.sum():.1f} %</td></tr>"
        for (reason, words), (red, green, blue) in zip(_REASONS.items(), page.reason_colors.tolist())
    )
    return f"<table><tr><th></th><th>pixels</th><th>share</th></tr>{rows}</table>"


def _round_ranges(baseline: float) -> list[float]:
    """1, 2, 5, 10 ... within the ranges of use."""
    exponent = int(np.floor(np.log10(_NEAREST * baseline)))
    steps = [m * 10.0**k for k in range(exponent, exponent + 4) for m in (1, 2, 5)]
    return [z for z in steps if _NEAREST * baseline <= z <= _FARTHEST * baseline]


def _ranges(page: StereoPage) -> str:
    """Depth error against range at the median standard deviation of this pair's disparities."""
    rig: Any = page.rig
    known = page.disparities.sigma_px[np.isfinite(page.disparities.sigma_px)]
    sigma = float(np.median(known)) if known.size else float("nan")
    rows = "".join(
        f"<tr><td>{z:g}</td><td>{number(rig.focal_px * rig.baseline / z - rig.principal_offset_px, 1)}</td>"
        f"<td>{number(z * z / (rig.focal_px * rig.baseline) * sigma, 4)}</td></tr>"
        for z in _round_ranges(rig.baseline)
    )
    words = (
        f'<p class="soft">f = {rig.focal_px:g} px, B = {rig.baseline:g}, and the median standard deviation {sigma:.3f} px. '
        "The error grows with the square of the depth.</p>"
    )
    return _section(
        "Error against range",
        f"{words}<table><tr><th>depth</th><th>disparity, px</th><th>error of depth</th></tr>{rows}</table>",
    )
