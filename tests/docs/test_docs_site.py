"""The built site, opened from disk in a browser: readable in two widths, without errors, and its search answers."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from page_checks import DESK, PHONE, check_accessibility, check_contrast, check_nothing_cut
from whole import IS_WHOLE

REPOSITORY = Path(__file__).parents[2]
BUILT = REPOSITORY / "build" / "site"
SAMPLE = [
    ("slam.html", "dark"),
    ("tutorials/01_project_a_point.html", "light"),
    ("commands/reconstruct.html", "light"),
]
"""Pages of most kinds; all of them in both themes in the whole run."""


def is_current(site: Path) -> bool:
    """Whether a site is newer than what it was built from."""
    index = site / "index.html"
    parts = [REPOSITORY / "mkdocs.yml", *REPOSITORY.glob("docs/**/*"), *REPOSITORY.glob("examples/*")]
    built_from = [p for p in parts if p.is_file() and p.suffix != ".pyc"]
    return index.is_file() and all(p.stat().st_mtime <= index.stat().st_mtime for p in built_from)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site that `make test` has built, or another one."""
    if is_current(BUILT):
        return BUILT
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(folder)]
    subprocess.run(command, cwd=REPOSITORY, check=True, timeout=200)
    return folder


@pytest.fixture(scope="module")
def tab(browser: Any) -> Iterator[Any]:
    page = browser.new_page(viewport=DESK)
    page.problems = []
    page.on("pageerror", lambda error: page.problems.append(str(error)))
    page.on("console", lambda said: page.problems.append(said.text) if said.type == "error" else None)
    yield page
    page.close()


def test_pages_are_readable(site: Path, tab: Any) -> None:
    everything = [(str(p.relative_to(site)), t) for p in site.rglob("*.html") for t in ("light", "dark")]
    for name, theme in everything if IS_WHOLE else SAMPLE:
        tab.emulate_media(color_scheme=theme)
        for size in (DESK, PHONE):
            tab.set_viewport_size(size)
            tab.goto((site / name).as_uri())
            check_nothing_cut(tab, name)
            if size == DESK or IS_WHOLE:
                check_accessibility(tab, with_contrast=IS_WHOLE)
            if size == DESK:  # the colors of a phone are the same
                check_contrast(tab, name, 0)
    assert not tab.problems


def test_the_search_answers(site: Path, tab: Any) -> None:
    tab.set_viewport_size(DESK)
    tab.goto((site / "index.html").as_uri())
    tab.click(".md-search__input")
    tab.keyboard.type("rolling shutter")
    tab.wait_for_selector(".md-search-result__link")
    links = tab.locator(".md-search-result__link").evaluate_all("all => all.map(link => link.href)")
    assert any("slam" in link for link in links)
    assert not tab.problems
