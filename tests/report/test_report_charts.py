"""Ticks, histograms and bars."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from epipole.report import charts


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0, 10, [0, 2, 4, 6, 8, 10]),
        (0, 1.04, [0, 0.2, 0.4, 0.6, 0.8, 1.0]),
        (-3.2, 3.1, [-3, -2, -1, 0, 1, 2, 3]),
        (1e6, 1e6 + 50, [1e6, 1e6 + 10, 1e6 + 20, 1e6 + 30, 1e6 + 40, 1e6 + 50]),
    ],
)
def test_ticks_are_round(low: float, high: float, expected: list[float]) -> None:
    assert charts.nice_ticks(low, high, 5) == pytest.approx(expected)


def test_ticks_of_an_empty_range() -> None:
    assert charts.nice_ticks(2.0, 2.0) == [2.0]
    assert charts.nice_ticks(float("nan"), 1.0) == []


def test_tick_text_is_short() -> None:
    assert [charts.tick_text(t) for t in (0.2, -3.0, 9000, 12000)] == ["0.2", "\u22123", "9000", "12k"]


def test_histogram_counts_every_value_once() -> None:
    values = np.random.default_rng(0).exponential(size=5000)
    histogram = charts.histogram_of(values, "x")
    assert histogram.counts.sum() + histogram.num_beyond == 5000
    third = (values >= histogram.edges[3]) & (values < histogram.edges[4])
    assert histogram.counts[3] == third.sum()
    assert histogram.num_beyond < 120
    assert histogram.median == np.median(values)


@pytest.mark.parametrize("values", [np.zeros(0), np.zeros(7), np.full(3, 2.5)])
def test_histogram_of_few_values(values: np.ndarray) -> None:
    histogram = charts.histogram_of(values, "x")
    assert histogram.counts.sum() + histogram.num_beyond == len(values)
    ElementTree.fromstring(charts.draw_histogram(histogram))


def test_histogram_of_integers_has_one_bin_each() -> None:
    values = np.array([2, 2, 3, 5, 9, 100], np.int64)
    histogram = charts.histogram_of_integers(values, "x", largest=9)
    assert histogram.edges[0] == 1.5
    assert histogram.counts.tolist() == [2, 1, 0, 1, 0, 0, 0, 1]
    assert histogram.num_beyond == 1


def test_bars_are_as_high_as_their_counts() -> None:
    histogram = charts.Histogram("x", np.arange(4.0), np.array([1, 4, 2]), 1.5, 0)
    drawing = charts.draw_histogram(histogram)
    heights = [float(h) for h in re.findall(r'class="bar"[^>]*height="([\d.]+)"', drawing)]
    assert np.divide(heights, heights[0]) == pytest.approx([1, 4, 2], abs=0.02)
    assert "median 1.50" in drawing


def test_timing_bars_are_as_long_as_their_stages() -> None:
    drawing = charts.draw_timings({"a<b": 10.0, "c": 5.0, "d": 0.0})
    root = ElementTree.fromstring(drawing)
    widths = [float(e.attrib["width"]) for e in root.iter() if e.attrib.get("class") == "bar"]
    assert widths[0] / widths[1] == pytest.approx(2.0, abs=0.01)
    assert root.find("text").text == "a<b"


def test_curves_are_drawn_on_logarithmic_axes():
    rendered = charts.draw_curves(
        {"near": ([1, 10, 100], [0.1, 0.01, 0.1]), "far": ([1, 100], [1.0, 2.0])}, "range", "px"
    )
    assert rendered.count('<path class="sequence"') == 1 and rendered.count('<path class="mark"') == 1
    assert ">near<" in rendered and ">far<" in rendered and ">100<" in rendered
    assert charts.draw_curves({"nothing": ([], [])}, "x", "y") == ""
    assert "nan" not in charts.draw_curves({"gap": ([1, 2, 3], [1.0, float("nan"), 2.0])}, "x", "y")
