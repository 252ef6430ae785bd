"""The page's script runs in a real browser, where one is installed."""

from html import escape
from pathlib import Path
from typing import Any

import pytest

from epipole.pipelines.sfm.page.content import ReportContent
from epipole.pipelines.sfm.page.page import render_report


def opened(page: str, browser: Any, folder: Path) -> Any:
    file = folder / "report.html"
    file.write_text(page, encoding="utf-8")
    tab = browser.new_page()
    tab.goto(file.as_uri())
    return tab


@pytest.mark.parametrize("name", ["hostile_content", "empty_content"])
def test_script_runs_to_its_end(
    name: str, request: pytest.FixtureRequest, browser: Any, tmp_path: Path
) -> None:
    content: ReportContent = request.getfixturevalue(name)
    tab = opened(render_report(content), browser, tmp_path)
    assert tab.locator("html").get_attribute("data-ready") == "yes"
    tab.close()


WRAPPER = """<html><body><iframe style="border:0;width:390px;height:6000px" srcdoc="{page}"></iframe><script>
const frame = document.querySelector("iframe");
frame.onload = () => {{
  const cells = [...frame.contentDocument.querySelectorAll(".images tbody td, .images tbody th")];
  const right = Math.max(...cells.map((cell) => cell.getBoundingClientRect().right));
  document.body.dataset.cells = cells.length;
  document.body.dataset.right = Math.ceil(right);
}};
</script></body></html>"""


def test_the_table_of_pictures_fits_a_narrow_screen(
    content: ReportContent, browser: Any, tmp_path: Path
) -> None:
    """State and error of each image are seen without scrolling sideways on 390 pixels."""
    page = render_report(content)
    tab = opened(WRAPPER.format(page=escape(page)), browser, tmp_path)
    found = tab.evaluate("({ ...document.body.dataset })")
    tab.close()
    assert int(found["cells"]) == 12 * 7 + 12 * 4
    assert int(found["right"]) <= 390
    assert page.count('data-head="Error"') == 12
