"""The page of a stereo pair: images, disparities, reasons for unknown pixels, depth error against range."""

from __future__ import annotations

import numpy as np

from epipole.pipelines.stereo.files import REASON_COLORS, StereoFiles
from epipole.pipelines.stereo.pair import StereoResult
from epipole.pipelines.stereo.scene import scene_of_pair
from epipole.report.charts import draw_histogram, histogram_of
from epipole.report.frame import render
from epipole.report.images import color_map_uri, color_range_text, png_uri
from epipole.report.space import SpaceData, space_data
from epipole.report.space_model import MAX_POINTS
from epipole.scene import StereoReason

_REASONS = {
    StereoReason.OK: "known",
    StereoReason.OCCLUDED: "not confirmed by the other image (occluded or mismatched)",
    StereoReason.OUT_OF_VIEW: "the match is outside the other image",
    StereoReason.AMBIGUOUS: "another disparity fits nearly as well",
    StereoReason.SPECKLE: "an isolated small region",
    StereoReason.TEXTURELESS: "no texture along the row",
    StereoReason.UNCERTAIN: "the standard deviation exceeds --max-sigma-px",
}


def render_page(result: StereoResult) -> str:
    """A self-contained HTML page."""
    found = result.disparities
    known = np.isfinite(found.disparity_px)
    return render(
        __package__,
        "stereo.html.jinja",
        title="Stereo pair",
        percent=f"{100 * found.density:.1f}",
        warnings=result.warnings,
        images=_images(result),
        space=_space(result),
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


def _space(result: StereoResult) -> SpaceData | None:
    """The points in 3D; None without depth."""
    if result.depths is None or result.rig is None or not np.isfinite(result.depths.depth).any():
        return None
    depth, sigma = (part.astype(np.float32) for part in (result.depths.depth, result.depths.sigma))
    files = StereoFiles(result.left_rgb, depth, sigma, result.rig.K)
    return space_data(scene_of_pair(files, "Stereo pair"), MAX_POINTS)


def _images(result: StereoResult) -> list[tuple[str, str]]:
    found = result.disparities
    images = [
        ("left", png_uri(result.left_rgb)),
        ("right", png_uri(result.right_rgb)),
        (f"disparity, {color_range_text(found.disparity_px)} px", color_map_uri(found.disparity_px)),
        (f"its standard deviation, {color_range_text(found.sigma_px)} px", color_map_uri(found.sigma_px)),
        ("unknown pixels by reason", png_uri(REASON_COLORS[found.reason])),
    ]
    if result.depths is not None:
        depth = result.depths.depth
        images.append((f"depth, {color_range_text(depth)}", color_map_uri(depth)))
    return images


def _reasons(result: StereoResult) -> list[tuple[str, str, str]]:
    counts = np.bincount(result.disparities.reason.ravel(), minlength=len(StereoReason))
    return [
        (f"rgb({red},{green},{blue})", words, f"{100 * counts[reason] / counts.sum():.1f}")
        for (reason, words), (red, green, blue) in zip(_REASONS.items(), REASON_COLORS.tolist())
    ]


def _median_sigma_px(result: StereoResult) -> float:
    known = result.disparities.sigma_px[np.isfinite(result.disparities.sigma_px)]
    return float(np.median(known)) if known.size else float("nan")


def _ranges(result: StereoResult) -> list[tuple[float, float, float]]:
    """(depth, disparity, depth error) at the median standard deviation of this pair's disparities."""
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
