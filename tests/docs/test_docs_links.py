"""Links of README.md and of the pages lead somewhere: files are there, and headings, too, which mkdocs checks for the site alone.

Pages that are generated when the site is built (commands, api, benchmarks, tutorials) are left to `mkdocs build --strict`.
"""

import re
from pathlib import Path

import pytest
from docs_pages import PAGES, ROOT

GENERATED = ("lesson/", "commands/", "api/", "benchmarks/", "tutorials/")
_CODE = re.compile(r"^ *```.*?^ *```|`[^`\n]*`", re.MULTILINE | re.DOTALL)


def links_of(page: Path) -> list[str]:
    text = _CODE.sub("", page.read_text(encoding="utf-8"))
    found = re.findall(r"\]\(([^)\s]+)(?: \"[^\"]*\")?\)", text) + re.findall(
        r"(?:src|href)=\"([^\"]+)\"", text
    )
    return [target for target in found if not re.match(r"[a-z]+:", target)]


def anchors_of(page: Path) -> set[str]:
    """Of the headings, as GitHub and mkdocs make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.+?) *$", text, re.MULTILINE)
    return {re.sub(r"\s", "-", re.sub(r"[^\w\s-]", "", heading.lower()).strip()) for heading in headings}


@pytest.mark.parametrize("name", PAGES)
def test_links_and_pictures_are_there(name: str) -> None:
    page, missing = PAGES[name], []
    for link in links_of(page):
        target, _, anchor = link.partition("#")
        path = page.parent / target if target else page
        inside = path.resolve().relative_to(ROOT / "docs").as_posix() if name != "README" else ""
        if inside.startswith(GENERATED):
            continue
        if not path.exists() or (anchor and path.suffix == ".md" and anchor not in anchors_of(path)):
            missing.append(link)
    assert not missing


BESIDE = {
    "commands/": "--help-all`",
    "api/": "`help(",
    "benchmarks/": "`benchmarks/README.md`",
    "lesson/": "`epipole lesson`",
}
"""Where to look instead, on a code host: a line with a link to a generated page names it, too."""


def test_a_link_to_a_generated_page_names_what_shows_the_same() -> None:
    wrong = []
    for name, page in ((name, page) for name, page in PAGES.items() if name != "README"):
        for paragraph in re.split(r"\n\s*\n|\n(?=\|)", page.read_text(encoding="utf-8")):
            for folder, instead in BESIDE.items():
                if (
                    re.search(rf"\]\((\.\./)*{folder}|href=\"(\.\./)*{folder}", paragraph)
                    and instead not in paragraph
                ):
                    wrong.append((name, folder, paragraph[:80]))
    assert not wrong


def test_pages_link_to_nothing_outside_of_the_site() -> None:
    wrong = [
        (name, link)
        for name, page in PAGES.items()
        if name != "README"
        for link in links_of(page)
        if not (page.parent / link.partition("#")[0]).resolve().is_relative_to(ROOT / "docs")
    ]
    assert not wrong


def test_lists_and_tables_are_seen_as_such() -> None:
    """The site's Markdown wants an empty line before a list, and four spaces before a table inside of one; GitHub does not mind."""
    wrong = []
    for name, page in {**PAGES, "benchmarks": ROOT / "benchmarks" / "README.md"}.items():
        lines = re.sub(
            r"^ *```.*?^ *```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL
        )
        wrong += [
            f"{name}: {found[0].strip()}"
            for found in re.finditer(r"^(?![-|\s]).*\n- .*", lines, re.MULTILINE)
        ]
        wrong += [f"{name}: {found[0].strip()}" for found in re.finditer(r"^ {1,3}\|.*", lines, re.MULTILINE)]
    assert not wrong
