"""The table of images: thumbnails with the features that have 3D points, numbers, and reasons."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from epipole.pipelines.sfm.page.content import ImageRow, ReportContent
from epipole.report.images import Thumbnail, thumbnail_of
from epipole.report.markup import count, number


@dataclass(frozen=True, slots=True)
class ImageLine:
    """One image's line in the table."""

    name: str
    is_registered: bool
    reason: str
    thumbnail: Thumbnail | None
    numbers: tuple[tuple[str, str], ...]
    """Sort key, empty for unknown, and text."""


def image_lines(content: ReportContent) -> list[ImageLine]:
    """The lines in order; unregistered images come first."""
    return [_line(row, content) for row in sorted(content.image_rows, key=lambda row: row.is_registered)]


def _line(row: ImageRow, content: ReportContent) -> ImageLine:
    used = row.num_observations / row.num_keypoints if row.num_keypoints else math.nan
    model = "\N{EN DASH}" if row.component < 0 else str(row.component + 1)
    error = number(row.mean_error_px) + (" px" if math.isfinite(row.mean_error_px) else "")
    jpeg, dots = content.thumbnails.get(row.name), content.inliers.get(row.name, np.zeros((0, 2)))
    return ImageLine(
        row.name,
        row.is_registered,
        row.reason or "reason not recorded",
        thumbnail_of(jpeg, dots) if jpeg else None,
        (
            *([(_key(row.component), model)] if content.other_components else []),
            (_key(row.num_keypoints), count(row.num_keypoints)),
            (_key(row.num_observations), count(row.num_observations)),
            (_key(used), f"{100 * used:.0f} %" if math.isfinite(used) else "\N{EN DASH}"),
            (_key(row.mean_error_px), error),
        ),
    )


def _key(value: int | float) -> str:
    return f"{value:.6g}" if math.isfinite(value) else ""
