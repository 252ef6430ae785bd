"""`epipole.share`: one page that shows Gaussians, as the rasterizer draws them."""

import base64
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browser_tab import Tab
from fields_scenes import scene, views

from epipole import share
from epipole.cameras import Camera
from epipole.cli.main import main
from epipole.errors import ConfigError, FileFormatError, WorkspaceError
from epipole.fields.splat.rasterizer import render
from epipole.io.gaussians.files import write_gaussians
from epipole.io.gaussians.ply import read_gaussian_ply
from epipole.pipelines.fields.scene import first_view_of, write_cameras
from epipole.pipelines.viewing.run import write_page
from epipole.report.frame import content_hash
from epipole.report.gaussians import ROW
from epipole.scene.gaussian_cloud import GaussianCloud
from epipole.synthetic import look_at

HOSTILE = "<img src=x onerror=alert(1)>.ply"
CONVERGED = "document.getElementById('space').dataset.settled === 'yes'"
LEAST_DB = 40.0
"""Of the page's drawing against the rasterizer's: 8 bits of each layer leave about 50."""


def seen_from_all_sides(num_sh: int = 4) -> GaussianCloud:
    """The scene, with colors that change with the direction."""
    rng = np.random.default_rng(1)
    more = rng.uniform(-0.5, 0.5, (len(scene()), num_sh - 1, 3)).astype(np.float32)
    return replace(scene(), sh=np.concatenate([scene().sh, more], axis=1))


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An output folder of `splat`, before white, with two cameras of which the second leans."""
    folder = tmp_path_factory.mktemp("result")
    cloud, seen = seen_from_all_sides(), list(views()[:2])
    seen[1] = replace(seen[1], cam_from_world=look_at((0.0, -3.0, 0.5), (0, 0, 0), (0.3, 0.1, 1.0)))
    write_gaussians(folder / "splat.ply", cloud)
    given = {"background": "white", "first_view": first_view_of(cloud.means_in_world, seen)}
    (folder / "summary.json").write_text(json.dumps(given))
    write_cameras(folder / "cameras.json", seen)
    return folder


@pytest.fixture(scope="module")
def page(result: Path) -> str:
    """The address of its page."""
    file = result.with_name("page.html")
    share(result, file)
    return file.as_uri()


class Blocks(HTMLParser):
    """Texts of the page's scripts by their ids, and the attributes of everything."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.scripts, self.attributes, self.inside = {}, [], None
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.attributes += [(tag, *pair) for pair in attrs]
        self.inside = dict(attrs).get("id", "code") if tag == "script" else None

    def handle_data(self, data):
        if self.inside is not None:
            self.scripts[self.inside] = self.scripts.get(self.inside, "") + data

    def handle_endtag(self, tag):
        self.inside = None


def test_a_page_holds_the_cloud_and_nothing_from_elsewhere(result: Path, tmp_path: Path) -> None:
    done = write_page(result, tmp_path / "page.html", 500_000)
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert done.num_bytes == len(text.encode()) and done.shown.startswith(
        "80 Gaussians; view-dependent colors"
    )
    assert sorted(p.name for p in tmp_path.iterdir()) == ["page.html"]
    blocks = Blocks(text)
    rows = np.frombuffer(base64.b64decode(blocks.scripts["space-gaussians"]), ROW)
    assert np.array_equal(rows["mean"], read_gaussian_ply(result / "splat.ply").means_in_world)
    assert len(base64.b64decode(blocks.scripts["space-harmonics"])) == 12 * 80
    given = json.loads(blocks.scripts["space-data"])
    assert given["gaussians"]["count"] == 80 and given["background"] == 1.0
    assert len(given["cameras"]["names"]) == 2 and not given["cameras"]["shown"]
    policy = next(v for tag, name, v in blocks.attributes if name == "content" and "default-src" in v)
    code = content_hash(blocks.scripts["code"])
    assert policy.startswith("default-src 'none'; img-src data:; style-src 'unsafe-inline'")
    assert policy.endswith(f"; script-src '{code}'; worker-src blob:") and "connect-src" not in policy
    names = {name for _, name, _ in blocks.attributes}
    assert not names & {"src", "href", "action", "data", "srcset"}
    assert not any(name.startswith("on") for name in names)
    assert not re.search(r"https?:|@import|url\(|[\"'(=]//", text)


def test_names_are_text(tmp_path: Path) -> None:
    write_gaussians(tmp_path / HOSTILE, scene())
    share(tmp_path / HOSTILE, tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<img src" not in text and text.count("&lt;img src=x onerror=alert(1)&gt;.ply") == 3


def test_gaussians_are_merged(result: Path, tmp_path: Path) -> None:
    done = write_page(result, tmp_path / "page.html", 30)
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert done.shown.endswith("; here 80 Gaussians merged into 30") and done.shown in text
    assert len(base64.b64decode(Blocks(text).scripts["space-gaussians"])) == 30 * 32


@pytest.mark.parametrize(
    ("num_sh", "said"), [(1, "do not depend on"), (4, "as trained"), (16, "degree 1, of 3")]
)
def test_the_page_says_what_its_colors_are(num_sh: int, said: str, tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", seen_from_all_sides(num_sh) if num_sh > 1 else scene())
    share(tmp_path / "a.ply", tmp_path / "page.html")
    assert said in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_what_cannot_be_shared(result: Path, tmp_path: Path) -> None:
    (tmp_path / "old.html").write_text("old")
    with pytest.raises(FileFormatError):
        share(tmp_path, tmp_path / "old.html")
    with pytest.raises(FileFormatError, match="it does not exist"):
        share(tmp_path / "none", tmp_path / "old.html")
    with pytest.raises(ConfigError, match=r"end in \.html"):
        share(result, result / "splat.ply")
    for most in (0, 10**9):
        with pytest.raises(ConfigError, match="share_max"):
            share(result, tmp_path / "old.html", share_max=most)
    (tmp_path / "damaged.ply").write_bytes((result / "splat.ply").read_bytes()[:-5])
    with pytest.raises(FileFormatError):
        share(tmp_path / "damaged.ply", tmp_path / "old.html")
    (tmp_path / "folder.html").mkdir()
    with pytest.raises(WorkspaceError):
        share(result, tmp_path / "folder.html")
    with pytest.raises(WorkspaceError, match="not written by epipole"):
        share(result, tmp_path / "old.html")
    assert (tmp_path / "old.html").read_text() == "old"
    for _ in range(2):  # the second time in the place of one of ours
        share(result, tmp_path / "new.html")


def test_the_command_writes_the_page_and_starts_no_server(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.html"
    given = ["view", str(result), "--share", str(page)]
    done = subprocess.run(
        [sys.executable, "-m", "epipole", *given, "--share-max", "50"],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert "page.html" in done.stdout and "80 Gaussians merged into 50" in done.stdout and page.is_file()
    with pytest.raises(SystemExit) as refused:
        main([*given, "--share-max", "0"])
    assert refused.value.code == 2 and "--share-max must be" in capsys.readouterr().err


@pytest.fixture
def tab(browser: Any) -> Iterator[Tab]:
    opened = Tab(browser.new_page(viewport=SMALL))
    yield opened
    opened.page.close()


SMALL = {"width": 480, "height": 400}


def drawn_by(tab: Tab) -> np.ndarray:
    """(h, w, 3) what is on the canvas."""
    tab.wait_until(CONVERGED)
    address = tab.value(
        "space.then(s => new Promise(done => { s.look.near = 0.01; s.snapshot(blob => { const reader = new FileReader();"
        " reader.onload = () => done(reader.result); reader.readAsDataURL(blob); }); }))"
    )
    data = np.frombuffer(base64.b64decode(address.partition(",")[2]), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1] / 255.0


def likeness_db(
    tab: Tab, cloud: GaussianCloud, position, middle, up, degrees: float, background: float
) -> float:
    """PSNR of the page's drawing against the rasterizer's from the same place."""
    found = drawn_by(tab)
    height, width = found.shape[:2]
    focal = 0.5 * min(width, height) / np.tan(np.deg2rad(0.5 * degrees))
    camera = Camera("PINHOLE", width, height, [focal, focal, 0.5 * (width - 1), 0.5 * (height - 1)])
    rendered = render(cloud, camera, look_at(position, middle, up))
    wanted = np.clip(rendered.over(np.full(3, background, np.float32)), 0, 1)
    assert wanted.std() > 0.05
    return float(-10 * np.log10(((found - wanted) ** 2).mean()))


def test_the_page_draws_as_the_rasterizer_does(page: str, tab: Tab) -> None:
    """From a side, from above with a lean, from within; and the same without a worker."""
    for position, middle, up, degrees in [
        ((2.0, 1.5, 0.7), (0.1, 0.0, 0.0), (0.0, 0.0, 1.0), 40.0),
        ((0.2, -0.1, 2.5), (0.0, 0.2, 0.0), (0.3, -1.0, 0.1), 60.0),
        ((0.1, 0.3, 0.2), (1.0, 0.2, 0.1), (0.0, -1.0, 0.0), 90.0),
    ]:
        address = f"#view={','.join(map(str, (*position, *middle, *up, degrees)))}"
        tab.open(page + address, 240, 200)
        assert likeness_db(tab, seen_from_all_sides(), position, middle, up, degrees, 1.0) > LEAST_DB
        seen = tab.image()
        assert seen.shape == (200, 240, 3) and seen[50:150].std() > 5
    tab.call("Page.addScriptToEvaluateOnNewDocument", source="Worker = undefined;")
    tab.open(page + address, 175, 240)
    assert likeness_db(tab, seen_from_all_sides(), position, middle, up, degrees, 1.0) > LEAST_DB
    assert tab.problems == []


def test_hands_and_keys_and_cameras(result: Path, page: str, tab: Tab) -> None:
    tab.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "reduce"}])
    tab.open(page)
    first = drawn_by(tab)
    given = json.loads((result / "summary.json").read_text())["first_view"]
    degrees = np.rad2deg(2 * np.arctan(0.75 * np.tan(np.deg2rad(25.0))))
    photometric_loss = likeness_db(
        tab, seen_from_all_sides(), given["position"], given["look_at"], given["up"], degrees, 1.0
    )
    assert photometric_loss > LEAST_DB

    def eye() -> dict[str, float]:
        return tab.value("space.then(s => s.view.eye())")

    def drag(**more: int) -> None:
        tab.mouse("mousePressed", 300, 300, button="left", buttons=1, clickCount=1, **more)
        tab.mouse("mouseMoved", 360, 310, button="left", buttons=1, **more)
        tab.mouse("mouseReleased", 360, 310, button="left", clickCount=1, **more)

    start = eye()
    drag()
    assert eye()["yaw"] != start["yaw"] and eye()["focus"] == start["focus"]
    rotated = eye()
    drag(modifiers=8)  # shift
    assert eye()["yaw"] == rotated["yaw"] and eye()["focus"] != start["focus"]
    tab.mouse("mouseWheel", 300, 300, deltaX=0, deltaY=-200)
    tab.wait_until(f"space.then(s => s.view.eye().dist < {start['dist'] - 1e-9})")
    assert np.abs(drawn_by(tab) - first).mean() > 0.01
    tab.value("document.getElementById('reset-view').click()")
    tab.wait_until(f"space.then(s => s.view.eye().yaw === {start['yaw']!r})")
    assert np.abs(drawn_by(tab) - first).max() < 0.02
    for key in ("ArrowLeft", "ArrowUp", "+", "r"):
        tab.call("Input.dispatchKeyEvent", type="keyDown", key=key)
    tab.wait_until(f"space.then(s => s.view.eye().yaw === {start['yaw']!r})")
    for number in (1, 2):
        tab.value("document.getElementById('next-camera').click()")
        assert tab.value("document.getElementById('camera-name').textContent").startswith(f"{number} of 2: 0")
    tab.wait_until("space.then(s => Math.abs(s.view.eye().roll) > 0.1)")
    position = look_at((0.0, -3.0, 0.5), (0, 0, 0), (0.3, 0.1, 1.0))
    basis = tab.value("space.then(s => s.view.basis())")
    rows = [basis["r"], basis["d"], basis["f"]]
    assert np.allclose(rows, position.rotation, atol=1e-5) and np.allclose(
        basis["o"], position.centers(), atol=1e-5
    )
    assert tab.problems == []


def test_a_double_click_looks_at_a_place(page: str, tab: Tab) -> None:
    tab.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "reduce"}])
    tab.open(page)
    tab.wait_until(CONVERGED)
    before = tab.value("space.then(s => s.view.eye())")
    for clicks in (1, 2):
        for kind in ("mousePressed", "mouseReleased"):
            tab.mouse(kind, 420, 340, button="left", clickCount=clicks)
    tab.wait_until(f"space.then(s => s.view.eye().focus[0] !== {before['focus'][0]!r})")
    focus = np.array(tab.value("space.then(s => s.view.eye())")["focus"])
    assert np.linalg.norm(focus) < 1.2  # on the ball of Gaussians


def test_a_browser_without_webgl_says_so(page: str, tab: Tab) -> None:
    source = "HTMLCanvasElement.prototype.getContext = () => null;"
    tab.call("Page.addScriptToEvaluateOnNewDocument", source=source)
    tab.open(page)
    assert "no WebGL2" in tab.value("document.getElementById('no-drawing').innerText")


def test_the_page_fits_a_phone(page: str, tab: Tab) -> None:
    tab.open(page, 390, 844)
    tab.wait_until(CONVERGED)
    width, height = tab.value("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]")
    assert width <= 390 and height <= 844
    boxes = tab.value("[...document.querySelectorAll('button')].map(b => b.getBoundingClientRect().right)")
    assert len(boxes) == 8 and max(boxes) <= 390
    assert tab.value("document.getElementById('space').clientHeight") > 400
