"""The page of a stereo pair: pictures, disparities, what is not known and why, error against range."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8

from epipole.image import color_map
from epipole.report.charts import draw_histogram, histogram_of
from epipole.report.markup import number
from epipole.report.plain_page import figure, notes_list, picture_uri, plain_page, section, span
from epipole.stereo import DepthMap, DisparityMap, RectifiedRig, StereoReason

_REASONS = {
    StereoReason.OK: "known",
    StereoReason.OCCLUDED: "the other picture does not confirm it (hidden there, or mistaken)",
    StereoReason.OUT_OF_VIEW: "its match lies beyond the other picture",
    StereoReason.AMBIGUOUS: "another disparity fits nearly as well",
    StereoReason.SPECKLE: "it stands alone among others",
    StereoReason.TEXTURELESS: "nothing around it changes along the row",
    StereoReason.UNSURE: "its standard deviation is larger than was asked for",
}


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
    warnings: tuple[str, ...]
    version: str


def render_stereo_page(page: StereoPage) -> str:
    """One HTML page with everything inside it."""
    found = page.disparities
    known = np.isfinite(found.disparity_px)
    pictures = [
        ("left", picture_uri(page.left_rgb)),
        ("right", picture_uri(page.right_rgb)),
        (f"disparity, {span(found.disparity_px)} px", picture_uri(color_map(found.disparity_px))),
        (f"its standard deviation, {span(found.sigma_px)} px", picture_uri(color_map(found.sigma_px))),
        ("what is not known, and why", picture_uri(page.reason_colors[found.reason])),
    ]
    if page.depths is not None:
        pictures.append((f"depth, {span(page.depths.depth)}", picture_uri(color_map(page.depths.depth))))
    histograms = [
        draw_histogram(histogram_of(found.disparity_px[known], "disparity, px")),
        draw_histogram(histogram_of(found.sigma_px[known], "standard deviation of disparity, px")),
    ]
    body = "".join(
        (
            f"<h1>Stereo pair: {100 * found.density:.1f} % of the left picture's pixels known</h1>",
            notes_list(page.warnings),
            section(
                "Pictures", f'<div class="figures">{"".join(figure(*picture) for picture in pictures)}</div>'
            ),
            section("What is known", _reasons(page)),
            section("Values", f'<div class="two">{"".join(histograms)}</div>'),
            _ranges(page) if page.rig is not None else "",
        )
    )
    return plain_page("Stereo pair", body, page.version)


def _reasons(page: StereoPage) -> str:
    counts = np.bincount(page.disparities.reason.ravel(), minlength=len(StereoReason))
    rows = "".join(
        f'<tr><td style="background:rgb({red},{green},{blue})">&emsp;</td><td>{words}</td>'
        f"<td>{100 * counts[reason] / counts.sum():.1f} %</td></tr>"
        for (reason, words), (red, green, blue) in zip(_REASONS.items(), page.reason_colors.tolist())
    )
    return f"<table><tr><th></th><th>pixels</th><th>share</th></tr>{rows}</table>"


def _ranges(page: StereoPage) -> str:
    """Depth error against range at the median standard deviation of this pair's disparities."""
    rig: Any = page.rig
    known = page.disparities.sigma_px[np.isfinite(page.disparities.sigma_px)]
    sigma = float(np.median(known)) if known.size else float("nan")
    rows = "".join(
        f"<tr><td>{z:g}</td><td>{number(rig.focal_px * rig.baseline / z - rig.principal_offset_px, 1)}</td>"
        f"<td>{number(z * z / (rig.focal_px * rig.baseline) * sigma, 4)}</td></tr>"
        for z in rig.round_ranges()
    )
    words = (
        f'<p class="soft">f = {rig.focal_px:g} px, B = {rig.baseline:g}, and the median standard deviation {sigma:.3f} px. '
        "The error grows with the square of the depth.</p>"
    )
    return section(
        "Error against range",
        f"{words}<table><tr><th>depth</th><th>disparity, px</th><th>error of depth</th></tr>{rows}</table>",
    )
