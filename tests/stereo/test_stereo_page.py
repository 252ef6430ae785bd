"""The page of a stereo pair: what it tells, and that names stay text."""

import re

import numpy as np
import pytest

from epipole._version import __version__
from epipole.pipelines.stereo.page import render_page
from epipole.pipelines.stereo.pair import StereoResult
from epipole.scene import DisparityMap, RectifiedRig, StereoReason


def page_of(warnings: tuple[str, ...] = (), rig: RectifiedRig | None = None) -> str:
    """An image of 40 x 30 pixels, the left half of it at 8 px, the other hidden."""
    is_known = np.arange(40) < 20
    disparity = np.broadcast_to(np.where(is_known, 8.0, np.nan), (30, 40)).astype(np.float32)
    reason = np.where(is_known, StereoReason.OK, StereoReason.OCCLUDED)
    found = DisparityMap(
        disparity, disparity / np.float32(16), np.broadcast_to(reason, (30, 40)).astype(np.uint8)
    )
    gray = np.full((30, 40, 3), 90, np.uint8)
    return render_page(StereoResult(gray, gray, found, rig, None, None, warnings, 0))


def test_shares_and_pictures() -> None:
    page = page_of()
    assert "<h1>Stereo pair: disparity of 50.0 % of the pixels</h1>" in page
    rows = re.findall(r"<td>([^<]*)</td><td>([\d.]+) %</td>", page)
    assert len(rows) == len(StereoReason) and rows[0] == ("known", "50.0")
    assert sum(float(fraction) for _, fraction in rows) == pytest.approx(100)
    assert page.count("<img src=") == 5 and "Error against range" not in page
    assert "<script" not in page and f"Made by epipole {__version__}." in page


def test_errors_against_range_follow_from_the_rig() -> None:
    page = page_of(rig=RectifiedRig(100.0, 19.5, 14.5, 0.2))
    rows = re.findall(r"<tr><td>([\d.]+)</td><td>([\d.]+)</td><td>([\d.]+)</td></tr>", page)
    assert len(rows) > 3
    for depth, disparity_px, error in np.array(rows, float):
        assert disparity_px == pytest.approx(20.0 / depth, abs=0.06)
        assert error == pytest.approx(depth**2 / 20.0 * 0.5, abs=6e-5)


def test_warnings_stay_text() -> None:
    page = page_of(("<b onclick=x>\"'&\x00\udcff.png",))
    page.encode("utf-8")
    assert '<li class="warn">&lt;b onclick=x&gt;&#34;&#39;&amp;\ufffd\ufffd.png</li>' in page
    assert '<ul class="notes">' not in page_of()
