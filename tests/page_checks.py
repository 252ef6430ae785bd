"""What every page must keep: contrast (also in charts), accessibility, nothing cut off, no error in the console."""

from pathlib import Path
from typing import Any

import pytest

SCRIPT = (Path(__file__).parent / "report" / "text_contrast.js").read_text(encoding="utf-8")


def check_contrast(page: Any, name: str, least_in_charts: int) -> None:
    """All text of the page that is open, also that of its charts, stands out from what is behind it."""
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    texts = page.evaluate(SCRIPT)
    known = [text for text in texts if text["isKnown"]]
    poor = [text for text in known if text["contrast"] < text["needed"]]
    assert not poor, (name, poor)
    assert len(known) >= 0.6 * len(texts) and len(known) >= 8, (name, len(known), len(texts))
    in_charts = [text for text in known if text["isSvg"]]
    assert len(in_charts) >= least_in_charts, name
    unknown = [text for text in texts if text["isSvg"] and not (text["isKnown"] or text["isOverPicture"])]
    assert len(unknown) <= len(in_charts), (name, unknown)


WCAG = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"]
PHONE, DESK = {"width": 390, "height": 844}, {"width": 1400, "height": 900}
SCROLLS = ".scroll, pre, .told, .md-typeset__scrollwrap, .md-typeset__table, .highlight, .md-sidebar, .md-search, .md-header"
"""What may be wider than the page because it scrolls by itself, or is folded away."""
CUT = """scrolls => [...document.querySelectorAll("main *:not(svg *), article *:not(svg *)")]
    .filter(e => e.checkVisibility() && !e.closest(scrolls) && e.getBoundingClientRect().right > innerWidth + 0.5)
    .map(e => e.outerHTML.slice(0, 120))"""


def check_accessibility(page: Any, *, with_contrast: bool = True) -> None:
    """No violation of WCAG 2.1 A and AA that axe-core finds.

    Contrast takes most of its time; pages that `check_contrast` sees, which also looks into charts, need it no second time.
    """
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    options = {"runOnly": {"type": "tag", "values": WCAG}, "resultTypes": ["violations"], "preload": False}
    options["rules"] = {"color-contrast": {"enabled": with_contrast}}
    found = axe.run(page, options=options).response["violations"]
    wrong = [(v["id"], [node["html"][:160] for node in v["nodes"]]) for v in found]
    assert not wrong, wrong


LEAST_TEXT_PX = 11.0
SMALL = """least => [...document.querySelectorAll("svg text")].filter(t => t.checkVisibility() && t.textContent.trim())
    .map(t => [parseFloat(getComputedStyle(t).fontSize) * Math.hypot(t.getScreenCTM().a, t.getScreenCTM().b), t.textContent])
    .filter(([size]) => size < least)"""
INSIDE = """() => [...document.querySelectorAll("svg[role=img] text")].filter(t => t.checkVisibility() && t.textContent.trim())
    .filter(t => { const a = t.getBoundingClientRect(), b = t.ownerSVGElement.getBoundingClientRect();
                   return a.left < b.left - 2 || a.right > b.right + 2 || a.bottom > b.bottom + 2; })
    .map(t => t.textContent)"""


def check_chart_texts(page: Any, name: str) -> None:
    """Texts of charts are large enough, and within their drawing."""
    small = page.evaluate(SMALL, LEAST_TEXT_PX)
    assert not small, (name, page.viewport_size, small)
    outside = page.evaluate(INSIDE)
    assert not outside, (name, page.viewport_size, outside)


def check_nothing_cut(page: Any, name: str) -> None:
    """Nothing is wider than the window."""
    width = page.viewport_size["width"]
    assert page.evaluate("document.scrollingElement.scrollWidth") <= width, (name, width)
    cut = page.evaluate(CUT, SCROLLS)
    assert not cut, (name, width, cut)
