"""The pages under docs/ name what exists."""

import re

from docs_pages import DOCS, PAGES

import epipole
from epipole import dense, geometry, robust, solvers


def test_functions_named_in_the_pages_exist() -> None:
    ours = [
        page for name, page in PAGES.items() if not name.startswith("coming_from/")
    ]  # these name others' functions
    text = "\n".join(page.read_text(encoding="utf-8") for page in ours)
    names = set(
        re.findall(
            r"`(?:epipole\.\w+\.)?((?:estimate|solve|triangulate|decompose|rectifying|verify)_\w+)`", text
        )
    )
    assert len(names) >= 10
    missing = [
        n for n in names if not any(hasattr(room, n) for room in (robust, geometry, solvers, dense, epipole))
    ]
    assert not missing


def test_kinds_of_pairs_are_all_explained() -> None:
    page = (DOCS / "pairs.md").read_text(encoding="utf-8")
    assert all(f"`{kind.name}`" in page for kind in robust.PairKind)
