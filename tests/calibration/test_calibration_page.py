"""The page of a calibration: what it tells, and that names stay text."""

import re

import numpy as np
import pytest
from calibration_views import LENS, OTHER, RIGHT_FROM_LEFT, board_places, views_of

from epipole.calibration import calibrate
from epipole.calibration.verdict import Verdict
from epipole.config import BoardConfig, CalibrationConfig
from epipole.geometry import Rigid3
from epipole.report.calibration import CalibrationPage, render_calibration_page

BOARD = BoardConfig(columns=9, rows=6, square=0.025)
HOSTILE = "<img src=x onerror=alert(1)>\"'\x00\udcff.png"


@pytest.fixture(scope="module")
def page() -> str:
    """Two cameras, eight views, every name hostile."""
    rng = np.random.default_rng(5)
    identity = Rigid3(np.eye(3), np.zeros(3))
    views = views_of([LENS, OTHER], [identity, RIGHT_FROM_LEFT], board_places(rng, 8), BOARD, rng)
    found = calibrate(views, [(640, 480), (640, 480)], CalibrationConfig(board=BOARD))
    verdict = Verdict(False, f"Fail: {HOSTILE}.", ())
    names = (tuple(HOSTILE for _ in range(8)),) * 2
    return render_calibration_page(
        CalibrationPage(found, None, verdict, names, {"a": f"{HOSTILE}: no board"}, "1.2.3")
    )


def test_the_page_tells_of_both_cameras_and_of_every_view(page: str) -> None:
    assert "<h1>Calibration of 2 cameras</h1>" in page
    titles = re.findall(r"<h2>([^<]*)</h2>", page)
    assert titles == ["Checks", "Left camera", "Right camera", "How the cameras stand", "Views"]
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
