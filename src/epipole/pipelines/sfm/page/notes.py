"""Notes that a reader should know before trusting the model."""

from __future__ import annotations

import numpy as np

from epipole.pipelines.sfm.page.content import ReportContent
from epipole.pipelines.sfm.page.statistics import LOW_PARALLAX_RAD, Statistics, num_low_parallax_pairs
from epipole.report.markup import count, plural


def notes_of(content: ReportContent, statistics: Statistics) -> tuple[tuple[str, bool], ...]:
    """Sentences, each with a flag that it is a warning; warnings first."""
    notes = [(text, True) for text in content.warnings]
    notes += [(text, True) for text in (_absent(content), _components(content)) if text]
    if not statistics.num_registered:
        return (
            *notes,
            ("There is no model: no image could be registered.", True),
        )
    notes.append((_scale(content.scale_note), False))
    notes += [(text, False) for text in (_parallax(content, statistics), _two_view(statistics)) if text]
    notes.append(
        (
            "The reprojection error shows how well the model explains the images it was made from. "
            "It is not the model's accuracy, which only a comparison with independent measurements shows.",
            False,
        )
    )
    return tuple(notes)


def _scale(note: str) -> str:
    sentence = note if "scale" in note.lower() else f"scale: {note}"
    return f"{sentence[:1].upper()}{sentence[1:]}."


def _absent(content: ReportContent) -> str:
    absent = sum(not row.is_registered for row in content.image_rows)
    if not absent:
        return ""
    verb = "is" if absent == 1 else "are"
    total = plural(len(content.image_rows), "image")
    return f"{count(absent)} of {total} {verb} not registered. The table of images gives the reason for each."


def _components(content: ReportContent) -> str:
    others = content.other_components
    if not others:
        return ""
    sizes = f"{', '.join(count(n) for n in others[:-1])} and {count(others[-1])}"
    if len(others) == 1:
        return (
            f"The images fell into two models that are not connected: this one and another of "
            f"{plural(others[0], 'image')}. More images between the two would join them."
        )
    return (
        f"The images fell into {len(others) + 1} models that are not connected. "
        f"This page shows the largest; the others have {sizes} images. "
        "More images between them would join them."
    )


def _parallax(content: ReportContent, statistics: Statistics) -> str:
    limit = f"{np.rad2deg(LOW_PARALLAX_RAD):.0f}°"
    pairs, low = len(content.view_graph), num_low_parallax_pairs(content.view_graph)
    angles = statistics.finite_angle_rad
    narrow = int((angles < LOW_PARALLAX_RAD).sum())
    sentences = []
    if low:
        sentences.append(
            f"{count(low)} of {plural(pairs, 'verified pair')} {'sees its' if low == 1 else 'see their'} "
            f"common points under a median angle below {limit}: "
            "such pairs determine rotations well and depth poorly."
        )
    if narrow >= 0.01 * len(angles) > 0:
        sentences.append(
            f"{100 * narrow / len(angles):.0f} % of the points have a largest triangulation angle below {limit}."
        )
    return " ".join(sentences)


def _two_view(statistics: Statistics) -> str:
    if not statistics.num_points:
        return ""
    fraction = 100 * float((statistics.track_length == 2).mean())
    if fraction < 1:
        return ""
    return f"{fraction:.0f} % of the points are seen in two images only, so no third image confirms them."
