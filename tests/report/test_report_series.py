"""Values over frames, strips of states, paths from above: read back from the drawings."""

import re
from xml.etree import ElementTree

import numpy as np

from epipole.report.path_plan import draw_path_plan
from epipole.report.series import Band, Line, draw_lines, draw_strip
from epipole.scene import Curve


def test_a_line_breaks_where_there_is_no_value():
    y = np.array([1.0, 2.0, np.nan, 3.0, np.nan, 1.0, 2.0])
    rendered = str(draw_lines([Line("", np.arange(7.0), y)], (0.0, 6.0), "points"))
    path = re.search(r'class="series accent" d="([^"]*)"', rendered)[1]
    assert path.count("M") == 3 and path.count("L") == 2 and path.count("m-2 0h4") == 1
    ElementTree.fromstring(rendered)


def test_what_lies_beyond_is_said():
    y = np.full(400, 10.0)
    y[7] = 5000.0
    rendered = str(draw_lines([Line("", np.arange(400.0), y)], (0.0, 399.0), "ms"))
    assert "1 beyond, up to 5e+03" in rendered
    heights = [
        float(v)
        for v in re.findall(r"[ML][\d.]+ ([\d.]+)", re.search(r'series accent" d="([^"]*)', rendered)[1])
    ]
    assert min(heights) >= 29.9
    assert draw_lines([Line("", np.arange(3.0), np.full(3, np.nan))], (0.0, 2.0), "ms") == ""
    assert draw_lines([], (0.0, 2.0), "ms") == ""
    assert "beyond" not in draw_lines([Line("", np.arange(3.0), np.zeros(3))], (0.0, 2.0), "ms")


def test_bands_follow_each_other_without_gaps():
    bands = [Band(0, 3, "starting", "a < b"), Band(4, 9, "tracking", "")]
    root = ElementTree.fromstring(str(draw_strip(bands, [0, 5], (0.0, 9.0))))
    first, second = (e for e in root if e.tag.endswith("rect"))
    assert first.get("class") == "band-starting" and first[0].text == "a < b"
    assert abs(float(first.get("x")) + float(first.get("width")) - float(second.get("x"))) < 0.02


def test_paths_from_above_keep_their_shape():
    square = np.array([[0.0, 0, 0], [4, 0, 9], [4, 4, 0], [0, 4, 0]])
    path = Curve("final", np.stack([square[:-1], square[1:]], axis=1), (1, 2, 3))
    none = Curve("causal", np.zeros((0, 2, 3)), (1, 2, 3))
    rendered = str(draw_path_plan([path, none], np.zeros((0, 3)), square[[0, 3]], "m"))
    at = re.search(r'class="series accent" d="M([^"]*)"', rendered)[1]
    corners = np.array([[float(v) for v in word.split()] for word in at.split("L")])
    sides = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    assert len(corners) == 4 and np.ptp(sides) < 0.2 and corners[0, 1] > corners[2, 1]
    assert "final" in rendered and "causal" not in rendered and "x (m)" in rendered
    assert draw_path_plan([none], np.zeros((0, 3)), square[[0, 3]], "m") == ""
