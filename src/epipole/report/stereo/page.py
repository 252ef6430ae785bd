"""What the page of a stereo pair shows: pictures, disparities, what is unknown and why, error against range."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from epipole.report.charts import draw_histogram, histogram_of
from epipole.report.frame import render
from epipole.report.pictures import color_map_uri, color_range_text, picture_uri
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
    return render(
        __package__,
        "stereo.html.jinja",
        title="Stereo pair",
        version=page.version,
        percent=f"{100 * found.density:.1f}",
        warnings=page.warnings,
        pictures=_pictures(page),
        reasons=_reasons(page),
        histograms=[
            draw_histogram(histogram_of(found.disparity_px[known], "disparity, px")),
            draw_histogram(histogram_of(found.sigma_px[known], "standard deviation of disparity, px")),
        ],
        rig=page.rig,
        sigma_px=f"{_median_sigma_px(page):.3f}",
        ranges=_ranges(page),
    )


def _pictures(page: StereoPage) -> list[tuple[str, str]]:
    """Caption and data URI of each picture."""
    found = page.disparities
    pictures = [
        ("left", picture_uri(page.left_rgb)),
        ("right", picture_uri(page.right_rgb)),
        (f"disparity, {color_range_text(found.disparity_px)} px", color_map_uri(found.disparity_px)),
        (f"its standard deviation, {color_range_text(found.sigma_px)} px", color_map_uri(found.sigma_px)),
        ("what is not known, and why", picture_uri(page.reason_colors[found.reason])),
    ]
    if page.depths is not None:
        depth = page.depths.depth
        pictures.append((f"depth, {color_range_text(depth)}", color_map_uri(depth)))
    return pictures


def _reasons(page: StereoPage) -> list[tuple[str, str, str]]:
    """Colour, words and share in percent of each reason."""
    counts = np.bincount(page.disparities.reason.ravel(), minlength=len(StereoReason))
    return [
        (f"rgb({red},{green},{blue})", words, f"{100 * counts[reason] / counts.sum():.1f}")
        for (reason, words), (red, green, blue) in zip(_REASONS.items(), page.reason_colors.tolist())
    ]


def _median_sigma_px(page: StereoPage) -> float:
    known = page.disparities.sigma_px[np.isfinite(page.disparities.sigma_px)]
    return float(np.median(known)) if known.size else float("nan")


def _ranges(page: StereoPage) -> list[tuple[float, float, float]]:
    """Depth, disparity and error of depth at the median standard deviation of this pair's disparities."""
    if page.rig is None:
        return []
    rig, sigma = page.rig, _median_sigma_px(page)
    return [
        (
            z,
            rig.focal_px * rig.baseline / z - rig.principal_offset_px,
            z * z / (rig.focal_px * rig.baseline) * sigma,
        )
        for z in rig.round_ranges()
    ]
