"""Every Python block of README.md and of the pages under docs/ runs, top to bottom, with the files and arrays that it names."""

from pathlib import Path
from typing import Any

import pytest
from docs_pages import PAGES, blocks_of
from docs_setups import IN_PLACE, PREPARED, two_views, usual

from epipole import api
from whole import IS_WHOLE

WITH_CODE = [name for name, path in PAGES.items() if blocks_of(path, "python", "py")]


LONG = {"surfaces"}
"""Pages whose code runs in the whole run only."""


def names_for(page: str, folder: Path, reconstructed: Path) -> dict[str, Any]:
    if page in IN_PLACE:
        return two_views()
    return PREPARED[page](folder) if page in PREPARED else usual(folder, reconstructed)


@pytest.mark.parametrize("page", WITH_CODE if IS_WHOLE else sorted({*WITH_CODE} - LONG))
def test_python_of_the_pages_runs(
    page: str, reconstructed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unchecked: None
) -> None:
    opened: list[Any] = []
    real = api.view
    monkeypatch.setattr(api, "view", lambda *a, **k: opened.append(real(*a, **k)) or opened[-1])
    folder = reconstructed if page in IN_PLACE else tmp_path
    names = names_for(page, folder, reconstructed)
    monkeypatch.chdir(folder)
    try:
        for number, block in enumerate(blocks_of(PAGES[page], "python", "py"), 1):
            exec(compile(block, f"{PAGES[page].name}, block {number}", "exec"), names)
    finally:
        for handle in opened:
            handle.stop()
    found = names.get("found")
    assert getattr(found, "success", True), found
    assert bool(opened) or page != "README"


def test_setups_are_those_of_pages() -> None:
    unknown = [name for name in (*PREPARED, *IN_PLACE) if name not in WITH_CODE]
    assert not unknown
