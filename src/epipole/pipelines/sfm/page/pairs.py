"""The table of pairs that contradict the others: both images, with the features that match."""

from __future__ import annotations

from dataclasses import dataclass

from epipole.pipelines.sfm.page.content import ReportContent
from epipole.report.images import Thumbnail, thumbnail_of

MAX_PAIRS_SHOWN = 12
"""Each shows two thumbnails of about 20 kB."""


@dataclass(frozen=True, slots=True)
class PairLine:
    """One pair's line in the table."""

    names: tuple[str, str]
    thumbnails: tuple[Thumbnail | None, ...]
    num_matches: int
    reason: str


def pair_lines(content: ReportContent) -> list[PairLine]:
    """The pairs with the most matches."""
    lines = []
    for pair in content.contradicting[:MAX_PAIRS_SHOWN]:
        jpegs = [content.thumbnails.get(name) for name in pair.names]
        thumbnails = tuple(thumbnail_of(j, dots) if j else None for j, dots in zip(jpegs, pair.positions))
        lines.append(PairLine(pair.names, thumbnails, pair.num_matches, pair.reason))
    return lines
