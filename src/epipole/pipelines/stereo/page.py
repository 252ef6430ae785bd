"""What the page of a stereo pair shows: images, disparities, what is unknown and why, error against range."""

from __future__ import annotations

import numpy as np

from epipole.pipelines.stereo.files import REASON_COLORS
from epipole.pipelines.stereo.pair import StereoResult
from epipole.report.charts import draw_histogram, histogram_of
from epipole.report.frame import render
from epipole.report.images import color_map_uri, color_range_text, png_uri
from epipole.scene import StereoReason

_REASONS = {
    StereoReason.OK: "known",
    StereoReason.OCCLUDED: "the other image does not confirm it (hidden there, or mistaken)",
    StereoReason.OUT_OF_VIEW: "its match lies beyond the other image",
    StereoReason.AMBIGUOUS: "another disparity fits nearly as well",
    StereoReason.SPECKLE: "it stands alone among others",
    StereoReason.TEXTURELESS: "nothing around it changes along the row",
    StereoReason.UNCERTAIN: "its standard deviation is larger than was asked for",
}


def render_page(result: StereoResult) -> str:
    """One HTML page with everything inside it."""
    found = result.disparities
    known = np.isfinite(found.disparity_px)
    return render(
        __package__,
        "stereo.html.jinja",
        title="Stereo pair",
        percent=f"{100 * found.density:.1f}",
        warnings=result.warnings,
        images=_images(result),
        reasons=_reasons(result),
        histograms=[
            draw_histogram(histogram_of(found.disparity_px[known], "disparity, px")),
            draw_histogram(histogram_of(found.sigma_px[known], "standard deviation of disparity, px")),
        ],
        error_model=result.error_model,
        rig=result.rig,
        sigma_px=f"{_median_sigma_px(result):.3f}",
        ranges=_ranges(result),
    )


def _images(result: StereoResult) -> list[tuple[str, str]]:
    """Caption and data URI of each image."""
    found = result.disparities
    images = [
        ("left", png_uri(result.left_rgb)),
        ("right", png_uri(result.right_rgb)),
        (f"disparity, {color_range_text(found.disparity_px)} px", color_map_uri(found.disparity_px)),
        (f"its standard deviation, {color_range_text(found.sigma_px)} px", color_map_uri(found.sigma_px)),
        ("what is not known, and why", png_uri(REASON_COLORS[found.reason])),
    ]
    if result.depths is not None:
        depth = result.depths.depth
        images.append((f"depth, {color_range_text(depth)}", color_map_uri(depth)))
    return images


def _reasons(result: StereoResult) -> list[tuple[str, str, str]]:
    """Colour, words and share in percent of each reason."""
    counts = np.bincount(result.disparities.reason.ravel(), minlength=len(StereoReason))
    return [
        (f"rgb({red},{green},{blue})", words, f"{100 * counts[reason] / counts.sum():.1f}")
        for (reason, words), (red, green, blue) in zip(_REASONS.items(), REASON_COLORS.tolist())
    ]


def _median_sigma_px(result: StereoResult) -> float:
    known = result.disparities.sigma_px[np.isfinite(result.disparities.sigma_px)]
    return float(np.median(known)) if known.size else float("nan")


def _ranges(result: StereoResult) -> list[tuple[float, float, float]]:
    """Depth, disparity and error of depth at the median standard deviation of this pair's disparities."""
    if result.rig is None:
        return []
    rig, sigma = result.rig, _median_sigma_px(result)
    return [
        (
            z,
            rig.focal_px * rig.baseline / z - rig.principal_offset_px,
            z * z / (rig.focal_px * rig.baseline) * sigma,
        )
        for z in rig.round_ranges()
    ]
