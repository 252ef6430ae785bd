"""The lesson's pages in a headless browser, through Playwright."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from epipole.lesson.run import export_lesson


class Tab:
    """A page of the lesson, what it says of errors and what it asks for from elsewhere."""

    def __init__(self, page: Any, folder: Path) -> None:
        self.page, self.folder, self.problems, self.loaded, self.num_moves = page, folder, [], [], 0
        page.on("pageerror", lambda error: self.problems.append(str(error)))
        page.on("console", lambda said: self.problems.append(said.text) if said.type == "error" else None)
        page.on("request", lambda request: self.loaded.append(request.url))

    def open(self, name: str) -> None:
        self.loaded.clear()
        self.page.goto((self.folder / name).as_uri())

    def set(self, **values: float) -> None:
        """Move sliders; one of them, another each time, has the event of the last move, for all are read at each."""
        self.num_moves += 1
        self.page.evaluate(
            """([values, number]) => {
                for (const [name, value] of Object.entries(values)) document.getElementById(name).value = value;
                const names = Object.keys(values);
                document.getElementById(names[number % names.length]).dispatchEvent(new Event("input"));
            }""",
            [{name: repr(float(value)) for name, value in values.items()}, self.num_moves],
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


SIZE = {"width": 1000, "height": 900}


@pytest.fixture(scope="module")
def tab_of_file(browser: Any, lesson: Path) -> Iterator[Tab]:
    """One tab for all tests of a file: each loads its page anew."""
    page = browser.new_page(viewport=SIZE)
    yield Tab(page, lesson)
    page.close()


@pytest.fixture(params=["light"])
def tab(request: pytest.FixtureRequest, tab_of_file: Tab) -> Iterator[Tab]:
    """A tab in one theme; it must say no error, and ask for nothing but pages of the lesson."""
    tab_of_file.page.goto("about:blank")
    tab_of_file.page.emulate_media(color_scheme=request.param)
    tab_of_file.page.set_viewport_size(SIZE)
    tab_of_file.page.mouse.move(0, 0)
    yield tab_of_file
    problems, tab_of_file.problems[:] = list(tab_of_file.problems), []
    assert not problems
