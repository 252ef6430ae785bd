"""The notes say what holds, and only that."""

from dataclasses import replace

import numpy as np
from report_ring import content_of, ring_model

from epipole.pipelines.sfm.page.content import ReportContent
from epipole.pipelines.sfm.page.notes import notes_of
from epipole.pipelines.sfm.page.statistics import statistics_of


def text_of(content: ReportContent) -> str:
    return "\n".join(text for text, _ in notes_of(content, statistics_of(content.reconstruction)))


def test_warnings_come_first(content: ReportContent) -> None:
    notes = notes_of(replace(content, warnings=("Mind the gap.",)), statistics_of(content.reconstruction))
    assert notes[0] == ("Mind the gap.", True)
    flags = [is_warning for _, is_warning in notes]
    assert flags == sorted(flags, reverse=True)


def test_pictures_without_a_place_are_counted(content: ReportContent) -> None:
    assert "2 of 12 images are not registered" in text_of(content)
    assert "not registered" not in text_of(content_of(ring_model(6, num_points=80, num_absent=0)))


def test_scale(content: ReportContent) -> None:
    assert "Up to scale: images alone do not determine lengths." in text_of(content)
    assert "Scale: meters from GPS." in text_of(replace(content, scale_note="meters from GPS"))


def test_components(content: ReportContent) -> None:
    assert "not connected" not in text_of(content)
    assert "two models" in text_of(replace(content, other_components=(3,)))
    assert "fell into 4 models" in text_of(replace(content, other_components=(5, 3, 2)))
    assert "have 5, 3 and 2 images" in text_of(replace(content, other_components=(5, 3, 2)))


def test_low_parallax_pairs(content: ReportContent) -> None:
    graph = content.view_graph
    angles = np.full(len(graph), 0.5)
    quiet = replace(content, view_graph=replace(graph, median_angle_rad=angles))
    assert "verified pair" not in text_of(quiet)
    angles = angles.copy()
    angles[:2] = 0.01
    loud = replace(content, view_graph=replace(graph, median_angle_rad=angles))
    assert f"2 of {len(graph)} verified pairs see their common points" in text_of(loud)


def test_no_model(empty_content: ReportContent) -> None:
    text = text_of(empty_content)
    assert "There is no model" in text
    assert "p to scale" not in text
