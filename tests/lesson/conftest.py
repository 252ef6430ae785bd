"""The lesson's pages in a headless browser, through Playwright."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from epipole.lesson.run import export_lesson


class Tab:
    """A page of the lesson, what it says of errors and what it asks for from elsewhere."""

    def __init__(self, page: Any, folder: Path) -> None:
        self.page, self.folder, self.problems, self.loaded = page, folder, [], []
        page.on("pageerror", lambda error: self.problems.append(str(error)))
        page.on("console", lambda said: self.problems.append(said.text) if said.type == "error" else None)
        page.on("request", lambda request: self.loaded.append(request.url))

    def open(self, name: str) -> None:
        self.loaded.clear()
        self.page.goto((self.folder / name).as_uri())

    def set(self, **values: float) -> None:
        """Move sliders as a hand does: each tells that it was moved."""
        self.page.evaluate(
            """values => { for (const [name, value] of Object.entries(values)) {
                const input = document.getElementById(name);
                input.value = value;
                input.dispatchEvent(new Event("input"));
            } }""",
            {name: repr(float(value)) for name, value in values.items()},
        )

    def shown(self) -> dict[str, float]:
        """All numbers of the page by their names, to the last digit."""
        found = self.page.evaluate(
            "() => Object.fromEntries([...document.querySelectorAll('[id][data-value]')].map(e => [e.id, e.dataset.value]))"
        )
        return {name: float(value.replace("Infinity", "inf")) for name, value in found.items()}

    def matrix(self, name: str) -> list[list[float]]:
        """A matrix that the page shows."""
        return self.page.evaluate(
            "id => [...document.getElementById(id).rows].map(r => [...r.cells].map(c => Number(c.dataset.value)))",
            f"matrix-{name}",
        )


@pytest.fixture(scope="session")
def lesson(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pages as files."""
    return export_lesson(tmp_path_factory.mktemp("lesson")).folder


@pytest.fixture(params=["light"])
def tab(request: pytest.FixtureRequest, browser: Any, lesson: Path) -> Iterator[Tab]:
    """A tab of its own; it must say no error, and ask for nothing but pages of the lesson."""
    page = browser.new_page(viewport={"width": 1000, "height": 900}, color_scheme=request.param)
    tab = Tab(page, lesson)
    yield tab
    page.close()
    assert not tab.problems
