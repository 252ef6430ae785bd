"""The page of a calibration: what it tells, and that names stay text."""

import re
from pathlib import Path

import numpy as np
import pytest
from calibration_views import LENS, OTHER, RIGHT_FROM_LEFT, board_places, views_of

from epipole.config import BoardConfig
from epipole.geometry import Rigid3
from epipole.pipelines.calibration.calibrate import calibrate_views
from epipole.pipelines.calibration.config import CalibrationConfig
from epipole.pipelines.calibration.files import CalibrationRun
from epipole.pipelines.calibration.page import render_page
from epipole.pipelines.calibration.verdict import Verdict

BOARD = BoardConfig(columns=9, rows=6, square=0.025)
HOSTILE = "<img src=x onerror=alert(1)>\"'\x00\udcff.png"


@pytest.fixture(scope="module")
def page() -> str:
    """Two cameras, eight views, every name hostile."""
    rng = np.random.default_rng(5)
    identity = Rigid3(np.eye(3), np.zeros(3))
    views = views_of([LENS, OTHER], [identity, RIGHT_FROM_LEFT], board_places(rng, 8), BOARD, rng)
    found = calibrate_views(views, [(640, 480), (640, 480)], CalibrationConfig(board=BOARD))
    verdict = Verdict(False, f"Fail: {HOSTILE}.", ())
    images = (tuple(Path(HOSTILE) for _ in range(8)),) * 2
    problems = {"a": f"{HOSTILE}: no board"}
    return render_page(CalibrationRun(Path("out"), found, None, verdict, images, problems))


def test_the_page_tells_of_both_cameras_and_of_every_view(page: str) -> None:
    assert "<h1>Calibration of 2 cameras</h1>" in page
    titles = re.findall(r"<h2>([^<]*)</h2>", page)
    assert titles == ["Checks", "Left camera", "Right camera", "Relative pose", "Views"]
    for name in LENS.model.param_names:
        assert page.count(f"<td>{name}</td>") == 2
    assert page.count('<td class="name">') == 16
    assert float(re.search(r"Baseline ([\d.]+)", page).group(1)) == pytest.approx(0.12, abs=0.001)
    assert "<script" not in page and not re.search(r"\bnan\b", re.sub('base64,[^"]*', "", page))


def test_names_and_sentences_stay_text(page: str) -> None:
    page.encode("utf-8")
    escaped = "&lt;img src=x onerror=alert(1)&gt;&#34;&#39;\ufffd\ufffd.png"
    assert page.count(escaped) == 16 + 2
    assert "<img src=x" not in page
    assert '<ul class="notes failed">' in page
