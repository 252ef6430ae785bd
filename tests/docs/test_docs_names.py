"""The pages under docs/ name what exists."""

import re
from pathlib import Path

import pytest

import epipole
from epipole import geometry, robust, solvers

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGES = sorted(DOCS.glob("*.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_links_and_pictures_are_there(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8"))
    missing = [t for t in targets if not t.startswith("http") and not (page.parent / t).is_file()]
    assert not missing


def test_functions_named_in_the_pages_exist() -> None:
    assert len(PAGES) >= 7
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    names = set(
        re.findall(
            r"`(?:epipole\.\w+\.)?((?:estimate|solve|triangulate|decompose|rectifying|verify)_\w+)`", text
        )
    )
    assert len(names) >= 10
    missing = [n for n in names if not any(hasattr(room, n) for room in (robust, geometry, solvers, epipole))]
    assert not missing


def test_kinds_of_pairs_are_all_explained() -> None:
    page = (DOCS / "pairs.md").read_text(encoding="utf-8")
    assert all(f"`{kind.name}`" in page for kind in robust.PairKind)
