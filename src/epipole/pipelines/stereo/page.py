"""What the page of a stereo pair shows."""

from __future__ import annotations

from epipole._version import __version__
from epipole.pipelines.stereo.files import REASON_COLORS
from epipole.pipelines.stereo.pair import StereoResult
from epipole.report.stereo_page import StereoPage, render_stereo_page


def render_page(result: StereoResult) -> str:
    """The report as one HTML page."""
    return render_stereo_page(
        StereoPage(
            *(result.left_rgb, result.right_rgb, result.disparities, REASON_COLORS),
            *(result.depths, result.rig, result.warnings, __version__),
        )
    )
