"""The page's script runs in a real browser, where one is installed."""

import shutil
import subprocess
from pathlib import Path

import pytest

from epipole.pipelines.sfm.page import render_report
from epipole.pipelines.sfm.page_content import ReportContent

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no chromium or chrome to open the report with")


def dom_after_script(page: str, folder: Path) -> str:
    file = folder / "report.html"
    file.write_text(page, encoding="utf-8")
    offline = [
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        "--disable-quic",
    ]
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", *offline]
    command += [f"--user-data-dir={folder / 'profile'}", "--dump-dom", file.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout


@pytest.mark.parametrize("name", ["hostile_content", "empty_content"])
def test_script_runs_to_its_end(name: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    content: ReportContent = request.getfixturevalue(name)
    dom = dom_after_script(render_report(content), tmp_path)
    assert 'data-ready="yes"' in dom[:200]
