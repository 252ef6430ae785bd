"""Files, constants and options that the pages on SLAM's method name exist."""

import re
from pathlib import Path

import pytest
from docs_pages import PAGES

from epipole.cli.main import _functions
from epipole.cli.options import option_names

REPOSITORY = Path(__file__).parents[2]
SLAM = REPOSITORY / "src" / "epipole" / "pipelines" / "slam"


@pytest.mark.parametrize("page", ["slam_method", "slam_covariances"])
def test_what_a_page_names_exists(page: str) -> None:
    text = PAGES[page].read_text()
    files = re.findall(r"`([\w/]+\.(?:py|npy))`", text)
    assert files and all((SLAM / name).is_file() or (REPOSITORY / name).is_file() for name in files), files
    source = "\n".join(path.read_text() for path in SLAM.rglob("*.py"))
    for name in re.findall(r"`([A-Z_]{4,})`", text):
        assert re.search(rf"^{name}\b.* = ", source, re.MULTILINE), name
    options = option_names(_functions()["slam"])
    for name in re.findall(r"`--(?:no-)?([\w-]+)", text):
        assert any(option == f"--{name}" or option.endswith(f".{name}") for option in options), name
