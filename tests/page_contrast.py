"""Contrast of the text of pages, also of the text in charts."""

from pathlib import Path
from typing import Any

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
