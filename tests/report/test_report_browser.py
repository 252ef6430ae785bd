"""The page's script runs in a real browser, where one is installed."""

import re
import shutil
import subprocess
from html import escape
from pathlib import Path

import pytest

from epipole.pipelines.sfm.page.content import ReportContent
from epipole.pipelines.sfm.page.page import render_report

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


WRAPPER = """<html><body><iframe style="border:0;width:390px;height:6000px" srcdoc="{page}"></iframe><script>
const frame = document.querySelector("iframe");
frame.onload = () => {{
  const cells = [...frame.contentDocument.querySelectorAll(".images tbody td, .images tbody th")];
  const right = Math.max(...cells.map((cell) => cell.getBoundingClientRect().right));
  document.body.dataset.cells = cells.length;
  document.body.dataset.right = Math.ceil(right);
}};
</script></body></html>"""


def test_the_table_of_pictures_fits_a_narrow_screen(content: ReportContent, tmp_path: Path) -> None:
    """State and error of each image are seen without scrolling sideways on 390 pixels."""
    page = render_report(content)
    dom = dom_after_script(WRAPPER.format(page=escape(page)), tmp_path)
    found = re.search(r'data-cells="(\d+)" data-right="(\d+)"', dom)
    assert found is not None and int(found[1]) == 12 * 7
    assert int(found[2]) <= 390
    assert page.count('data-head="Error"') == 12
