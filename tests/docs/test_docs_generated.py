"""The pages that the site makes of the examples, the command line, the packages and the measured results."""

import json
import sys
from pathlib import Path

import pytest
from docs_pages import DOCS

from epipole.cli import main as command_line
from epipole.cli.options import option_names

sys.path.insert(0, str(DOCS / "_hooks"))
from api_pages import api_pages
from benchmark_pages import benchmark_pages
from benchmark_tables import Measure, flat, medians, number, standing, table
from command_pages import command_pages
from tutorial_pages import blocks, tutorial_pages

EXAMPLE = '''"""Two numbers and their sum.

What a sum is.
"""

import math

# Prose with an image: ![a sum](docs/pictures/sum.png)
# in two lines.

# A second paragraph.

one = math.sqrt(1.0)
# belongs to the next line
two = """
# no comment

"""
assert one == 1.0  # at the end

# The last word.
'''


def test_an_example_becomes_a_page(tmp_path: Path) -> None:
    (tmp_path / "02_sum.py").write_text(EXAMPLE)
    (tmp_path / "helper.py").write_text("")
    (page,) = tutorial_pages(tmp_path).items()
    assert page[0] == "tutorials/02_sum.md"
    assert page[1].startswith(
        "# Two numbers and their sum\n\nWhat a sum is.\n\n```python\nimport math\n```\n\nProse with"
    )
    assert "![a sum](../pictures/sum.png)\nin two lines.\n\nA second paragraph.\n\n```python\none" in page[1]
    assert "# belongs to the next line\ntwo = " in page[1] and "\n# no comment\n" in page[1]
    assert "\n```\n\nThe last word.\n\nThe whole file is `examples/02_sum.py`" in page[1]


def test_code_of_an_example_is_kept() -> None:
    code = "\n".join(text for kind, text in blocks(EXAMPLE) if kind == "code")
    names: dict[str, object] = {}
    exec(code, names)
    assert names["two"] == "\n# no comment\n\n"


def test_every_command_and_option_has_its_row() -> None:
    pages = command_pages()
    for name, function in command_line._functions().items():
        page = pages[f"commands/{name}.md"]
        assert f"({name}.md)" in pages["commands/index.md"]
        assert not [option for option in option_names(function) if f"`{option}`" not in page]
        rows = [line for line in page.splitlines() if line.startswith("|")]
        assert all(row.replace("\\|", "").count("|") in (3, 5) for row in rows)


def test_names_of_the_api_stand_once() -> None:
    pages = api_pages()
    described = [line for page in pages.values() for line in page.splitlines() if line.startswith("::: ")]
    assert len(described) == len(set(described)) > 200
    assert "::: epipole.robust.pairs.two_view.estimate_relative_pose" in pages["api/robust.md"]


def test_a_loss_is_told() -> None:
    rows = {"epipole": {"s": 1.0, "e": 2.0}, "A": {"s": 1.01, "e": 1.0}, "B": {"s": 3.0, "e": None}}
    given = standing(rows, [Measure("s", "time"), Measure("e", "error"), Measure("x", "nothing")])
    assert given.splitlines()[2:] == ["| time | B | A |  |", "| error |  |  | A |"]
    assert standing({"A": {"s": 1.0}}, [Measure("s", "time")]) == ""
    more = standing({"epipole": {"f": 0.9}, "A": {"f": 0.5}}, [Measure("f", "found", higher_is_better=True)])
    assert more.endswith("| found | A |  |  |")


def test_numbers_and_rows() -> None:
    assert [number(v) for v in (None, True, 12345, 0.012345, 1234.5, 23.456)] == [
        "",
        "yes",
        "12,345",
        "0.0123",
        "1,234",
        "23.46",
    ]
    assert flat({"a": {"b_c": 1}, "d": [1, 2], "e": [1, 2, 3, 4], "f": []}) == {
        "a b c": 1,
        "d": [1, 2],
        "f": None,
    }
    assert medians([{"x": 1}, {"x": 3}, {"x": 9}]) == {"runs": 3, "x": 3}
    assert table({"A": {"x": 1, "y": None}}) == "|  | x |\n|---|---:|\n| A | 1 |"


def test_every_result_file_has_a_section() -> None:
    results = DOCS.parent / "benchmarks" / "results"
    text = "\n".join(benchmark_pages().values())
    missing = [
        path.name for path in results.glob("*.json") if f"*`benchmarks/results/{path.name}`" not in text
    ]
    assert not missing


@pytest.mark.parametrize(
    "content", [{"x": 1.5}, [{"a": 1}], {"rows": [{"name": "n", "v": 2}], "few": {"k": {"v": 1}}}]
)
def test_unknown_files_are_shown_too(content: object, tmp_path: Path) -> None:
    results = tmp_path / "results"
    results.mkdir()
    (tmp_path / "README.md").write_text("# Benchmarks\n")
    (results / "unheard_of.json").write_text(json.dumps(content))
    pages = benchmark_pages(results)
    assert "## unheard of" in pages["benchmarks/more.md"] and "|---|" in pages["benchmarks/more.md"]
    assert pages["benchmarks/protocol.md"] == "# Protocol\n"
