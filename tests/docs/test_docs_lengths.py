"""Pages that can be read: the README fits in one screen or two, a how-to page takes less than five minutes."""

import re
from pathlib import Path

import yaml
from docs_pages import PAGES

REPOSITORY = Path(__file__).parents[2]
MOST_LINES = 120
MOST_WORDS = 1000


def pages_of(part: object) -> list[str]:
    """Pages below a part of the navigation."""
    if isinstance(part, str):
        return [part]
    below = part.values() if isinstance(part, dict) else part
    return [page for one in below for page in pages_of(one)]  # type: ignore[union-attr]


def how_to_pages() -> list[str]:
    text = re.sub(r"!!python\S*|!ENV", "", (REPOSITORY / "mkdocs.yml").read_text())
    nav = yaml.safe_load(text)["nav"]
    return next(pages_of(part["How to"]) for part in nav if "How to" in part)


def words_of(text: str) -> int:
    """Words of the text, without blocks of code and tables' rules."""
    return len(re.findall(r"[A-Za-z][\w'-]*", re.sub(r"```.*?```", "", text, flags=re.DOTALL)))


def test_the_readme_is_short() -> None:
    lines = (REPOSITORY / "README.md").read_text().splitlines()
    assert len(lines) <= MOST_LINES


def test_how_to_pages_are_short_and_have_headings() -> None:
    pages = how_to_pages()
    assert len(pages) > 15
    for name in pages:
        text = (REPOSITORY / "docs" / name).read_text()
        assert words_of(text) <= MOST_WORDS, f"{name}: {words_of(text)} words"
        assert len(re.findall(r"^## ", text, re.MULTILINE)) >= 2, f"{name} has no headings"


def test_every_table_has_a_header() -> None:
    """Rows after a blank line or text, without a header of their own, are shown as text with bars."""
    for page in PAGES.values():
        lines = page.read_text(encoding="utf-8").splitlines()
        for n, line in enumerate(lines[:-1]):
            if line.startswith("| ") and not (n and lines[n - 1].startswith("|")):
                assert re.match(r"\|[\s:|-]+\|$", lines[n + 1]), f"{page.name}: line {n + 1}"
