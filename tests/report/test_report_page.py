"""The whole page: self-contained, safe, complete, small."""

import base64
import hashlib
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest
from report_ring import HOSTILE, content_of, empty_model

from epipole._version import __version__
from epipole.pipelines.sfm.page.content import ReportContent
from epipole.pipelines.sfm.page.page import render_report

VOID = {"meta", "input", "br", "img", "link"}


class Reader(HTMLParser):
    """Collects elements and text; complains about elements that do not close in order."""

    def __init__(self) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.stack.append(tag)

    def handle_startendtag(self, tag: str, attrs: list) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.stack.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def read(page: str) -> Reader:
    reader = Reader()
    reader.feed(page)
    reader.close()
    assert reader.stack == []
    return reader


def block(page: str, element_id: str) -> object:
    found = re.search(rf'<script type="application/json" id="{element_id}">(.*?)</script>', page, re.DOTALL)
    return json.loads(found.group(1))


@pytest.fixture(scope="module")
def page(content: ReportContent) -> str:
    return render_report(content)


def test_page_is_well_formed_and_loads_nothing(page: str) -> None:
    reader = read(page)
    assert not re.search(r"(https?:)?//[a-z0-9.-]+\.[a-z]{2,}", page)
    for tag, attributes in reader.elements:
        assert tag not in ("link", "iframe", "base", "object")
        assert "src" not in attributes
        assert attributes.get("href", "data:").startswith("data:")
    (policy,) = (a["content"] for t, a in reader.elements if t == "meta" and "http-equiv" in a)
    assert policy.startswith("default-src 'none'; ")
    # The one script that may run is the page's, by its hash.
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")
    assert re.search(r"script-src ([^;]*)", policy).group(1) == f"'sha256-{digest}'"


def test_header_numbers(page: str, content: ReportContent) -> None:
    tiles = dict(re.findall(r"<div><dt>([^<]*)</dt><dd>(.*?)</dd></div>", page))
    model = content.reconstruction
    assert tiles["Images registered"] == "10 <small>of 12</small>"
    assert tiles["Points"] == "400"
    assert tiles["Observations"].replace("\u202f", "") == str(len(model.tracks.image))
    assert tiles["Mean reprojection error"] == f"{model.mean_reprojection_error_px():.2f} <small>px</small>"
    assert tiles["Mean track length"] == f"{len(model.tracks.image) / 400:.2f}"
    assert tiles["Time"] == "1 min 54 s"


def test_truth_settings_cameras_and_timings_are_told(content: ReportContent) -> None:
    page = render_report(replace(content, truth_errors={"Camera position, median": "12 mm"}))
    assert "<dt>Camera position, median</dt><dd>12 mm</dd>" in page
    text = "\n".join(read(page).text)
    for expected in ("features.max_keypoints", "8000", "PINHOLE, 640x480", "matching", "8.2 s", __version__):
        assert expected in text


def test_match_matrix_holds_every_pair(page: str, content: ReportContent) -> None:
    pairs, graph = block(page, "pairs"), content.view_graph
    assert pairs["first"] == graph.image1.tolist()
    assert pairs["count"] == graph.num_inliers().tolist()
    assert [pairs["kinds"][str(k)] for k in pairs["kind"][:2]] == ["planar", "general"]
    assert pairs["angle"][0] == 1.0
    assert pairs["angle"][3] is None
    assert pairs["placed"] == list(range(10))
    assert block(page, "names") == list(content.reconstruction.images.name)


def test_hostile_names_stay_text(hostile_content: ReportContent) -> None:
    page = render_report(hostile_content)
    page.encode("utf-8")
    reader = read(page)
    assert "img" not in {tag for tag, _ in reader.elements}
    assert not any(key.startswith("on") for _, attributes in reader.elements for key in attributes)
    scripts = [a for tag, a in reader.elements if tag == "script"]
    ids = [a.get("id") for a in scripts]
    assert ids[0] == "space-data" and ids[-3:] == ["pairs", "names", None]
    assert all(a.get("type") == "application/octet-stream" for a in scripts[1:-3])
    shown = HOSTILE.replace("\u202e", "\ufffd")  # what would turn the rest of the name around
    assert shown in reader.text and "\u202e" not in page and "u202e" not in page
    names = [name.replace("\u202e", "\ufffd") for name in hostile_content.reconstruction.images.name]
    assert block(page, "names") == names


@pytest.mark.parametrize("num_images", [0, 1, 4])
def test_a_page_without_a_model(num_images: int) -> None:
    page = render_report(content_of(empty_model(num_images), "Nothing"))
    text = "\n".join(read(page).text)
    assert "No model could be made" in text
    assert "There is no model to show." in text
    assert text.count("too few matches") == num_images
    assert not re.search(r"\bnan\b", text.split('"use strict"')[0])


def test_fifty_pictures_and_many_points_stay_small(big_content: ReportContent) -> None:
    page = render_report(big_content)
    assert block(page, "space-data")["points"][0]["count"] == 40_000
    assert len(page.encode("utf-8")) < 8e6
