"""Every report can be read in both themes and two widths: contrast (also in charts), accessibility, nothing cut off."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from benchmarks.tasks.surfaces import prepare_scene

import epipole
from epipole import api, splat
from epipole.io.colmap.model import write_colmap_model
from epipole.pipelines.localization.page import render_page
from epipole.pipelines.sfm.page.content import ReportContent
from epipole.pipelines.sfm.page.page import render_report
from epipole.pipelines.slam.run import slam as run_slam
from epipole.scene import Reconstruction, RectifiedRig
from io_models import mappable_model, write_gcp_list
from page_checks import (
    DESK,
    PHONE,
    SCRIPT,
    check_accessibility,
    check_chart_texts,
    check_contrast,
    check_nothing_cut,
)
from pairwise import each_once
from whole import IS_WHOLE

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "calibration"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "fields"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "slam"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "stereo"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "viewer"))
from fields_scenes import camera, frames_of, views
from slam_rides import write_pairs
from test_calibration_page import page as calibration_page
from test_stereo_page import page_of
from test_viewer_kinds import workspace

pytestmark = pytest.mark.usefixtures("unchecked_module")
PAGES = {
    "reconstruction": 2,
    "nothing-reconstructed": 0,
    "slam": 4,
    "stereo": 0,
    "calibration": 0,
    "field": 3,
    "scene": 0,
    "localization": 0,
    "georeference": 0,
    "surface": 0,
}
"""Of every kind of report: the least number of texts in its charts."""
TEMPLATES = {
    "reconstruction": ("reconstruction", "nothing-reconstructed"),
    **{
        name: (name,)
        for name in (
            "slam",
            "stereo",
            "calibration",
            "field",
            "scene",
            "localization",
            "georeference",
            "surface",
        )
    },
}


def localization_page(model: Reconstruction) -> str:
    """A report of one localized image, and one that is not."""
    name = model.images.name[0]
    entry = {
        "is_localized": True,
        "position_in_world": [1.0, -2.0, 0.5],
        "position_sigma": 0.0123,
        "rotation_sigma_deg": 0.045,
        "num_points": 1234,
        "error_px": 0.82,
        "camera": {"params": [525.5]},
        "focal_source": "the model's camera",
    }
    lost = {"is_localized": False, "num_matches": 31, "num_inliers": 5}
    return render_page(
        ["something is wrong"],
        model,
        (name,),
        {name: entry, "lost.jpg": lost},
        {"lost.jpg": "no pose fits enough of its matches with the model"},
        "m",
    )


def georeference_page(root: Path) -> str:
    """A report of a model with control points, of which one is rejected, and check points."""
    model = mappable_model()
    write_colmap_model(model, root / "surveyed" / "sparse" / "0")
    write_gcp_list(root / "gcp_list.txt", model, num_control=6)
    lines = (root / "gcp_list.txt").read_text().splitlines()
    own = [n for n, line in enumerate(lines) if line.endswith(" P3")]
    for n in own:
        x, rest = lines[n].split(" ", 1)
        lines[n] = f"{float(x) + 1.0} {rest}"
    (root / "gcp_list.txt").write_text("\n".join(lines))
    found = api.georeference(root / "surveyed", gcp=root / "gcp_list.txt")
    assert found.points["P3"]["role"] == "rejected"
    return (found.out / "report.html").read_text(encoding="utf-8")


def surface_page(root: Path) -> str:
    """A report of the surface of a few rendered images."""
    scene = prepare_scene("courtyard", root, (192, 128), 5)
    return (api.surface(scene.folder, root / "surface").out / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def reports(
    tmp_path_factory: pytest.TempPathFactory, content: ReportContent, empty_content: ReportContent
) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("pages")
    ride = write_pairs(root / "ride", 6)
    run_slam(ride, root / "slam", truth=ride)
    (root / "photos").mkdir()
    transforms = camera() | {"frames": frames_of(views(6), root / "photos")}
    (root / "photos" / "transforms.json").write_text(json.dumps(transforms))
    splat(root / "photos", root / "splat", steps=6, max_gaussians=200, sh_degree=0, test_every=3)
    (root / "workspace").mkdir()
    api.share(workspace(root / "workspace"), root / "scene.html")
    pages = {
        "reconstruction": render_report(content),
        "nothing-reconstructed": render_report(empty_content),
        "stereo": page_of(("something is wrong",), RectifiedRig(40.0, 20.0, 15.0, 0.1)),
        "calibration": calibration_page.__wrapped__(),
        "localization": localization_page(content.reconstruction),
        "georeference": georeference_page(root),
        "surface": surface_page(root),
    }
    for name, html in pages.items():
        (root / f"{name}.html").write_text(html, encoding="utf-8", errors="replace")
    found = {"slam": root / "slam" / "report.html", "field": root / "splat" / "report.html"}
    return {name: found.get(name, root / f"{name}.html") for name in PAGES}


@pytest.fixture(scope="module")
def tab_of_file(browser: Any) -> Iterator[Any]:
    page = browser.new_page(viewport=DESK)
    page.set_default_timeout(60_000)
    page.problems = []
    page.on("pageerror", lambda error: page.problems.append(str(error)))
    page.on("console", lambda said: page.problems.append(said.text) if said.type == "error" else None)
    yield page
    page.close()


@pytest.fixture(params=["light", "dark"])
def tab(request: pytest.FixtureRequest, tab_of_file: Any) -> Any:
    tab_of_file.emulate_media(color_scheme=request.param)
    tab_of_file.set_viewport_size(DESK)
    return tab_of_file


def test_every_template_of_a_page_is_here() -> None:
    source = Path(epipole.__file__).parent
    extending = [p for p in source.rglob("*.html.jinja") if "{% extends" in p.read_text(encoding="utf-8")]
    names = {path.name.removesuffix(".html.jinja") for path in extending if path.parts[-3] != "lesson"}
    assert names == set(TEMPLATES) and {name for all_of in TEMPLATES.values() for name in all_of} == set(
        PAGES
    )


@pytest.mark.parametrize(("name", "tab"), each_once([*PAGES], ("light", "dark")), indirect=["tab"])
def test_reports(name: str, reports: dict[str, Path], tab: Any) -> None:
    tab.problems.clear()
    tab.goto(reports[name].as_uri())
    check_contrast(tab, name, PAGES[name])
    for size in (DESK, PHONE):
        tab.set_viewport_size(size)
        if size == DESK or IS_WHOLE:
            check_accessibility(tab, with_contrast=IS_WHOLE)
        check_nothing_cut(tab, name)
    check_chart_texts(tab, name)  # on a phone
    assert not tab.problems


BROKEN = """<!doctype html><body style="background:#fff;color:#222">
<p>readable</p><p style="color:#bbb">pale</p><div style="background:#111"><svg width="200" height="60">
<rect width="100" height="60" fill="#eee"/><text id="good" x="5" y="30" fill="#222">on light</text>
<text x="110" y="30" fill="#222">on dark</text><text x="110" y="55" fill="#fff" fill-opacity="0.2">faint</text></svg></div>"""


def test_the_check_finds_text_that_cannot_be_read(tmp_path: Path, tab: Any) -> None:
    (tmp_path / "broken.html").write_text(BROKEN)
    tab.goto((tmp_path / "broken.html").as_uri())
    poor = [text["text"] for text in tab.evaluate(SCRIPT) if text["contrast"] < text["needed"]]
    assert poor == ["pale", "on dark", "faint"]
