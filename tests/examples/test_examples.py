"""Every example runs as the main program, as a reader starts it: its own asserts are the checks of what it says."""

import ast
import json
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from answering_process import AnsweringProcess
from whole import IS_WHOLE

FOLDER = Path(__file__).resolve().parents[2] / "examples"
EXAMPLES = sorted(FOLDER.glob("*.py"))
TRAINING = ("12_gaussian_splats", "13_radiance_field")
"""Trainings for longer than what the tests of fields train; these run in the whole run."""
LONG = ("08_calibrate_a_camera", "10_slam_frame_by_frame")
QUICK = [path for path in EXAMPLES if path.stem not in (*TRAINING, *LONG)]
LONGEST_S = 300
"""With kernels that are not compiled yet; each takes a few seconds with them."""


@pytest.fixture(scope="module")
def programs() -> Iterator[AnsweringProcess]:
    """A process that runs examples one after the other."""
    env = {"PYTHONOPTIMIZE": "", "PYTHONWARNINGS": "error::DeprecationWarning:__main__"}
    process = AnsweringProcess(Path(__file__).with_name("example_process.py"), env)
    yield process
    process.close()


@pytest.mark.parametrize("path", EXAMPLES if IS_WHOLE else QUICK, ids=lambda path: path.stem)
def test_an_example_runs(path, tmp_path, programs):
    here, out = tmp_path / "here", tmp_path / "out"
    here.mkdir()
    line = programs.ask([str(path), str(here), str(out)], LONGEST_S)
    if IS_WHOLE:
        programs.close()  # no example may depend on what an earlier one has imported
    assert line, f"{path.name} ended the process ({programs.died_with}), or took more than {LONGEST_S} s"
    is_well, printed = json.loads(line)
    assert is_well, printed
    assert printed.strip()
    assert not list(here.iterdir()), "it writes beside the folder that it is given"


def test_examples_are_numbered():
    numbers = [int(path.name[:2]) for path in EXAMPLES]
    assert numbers == list(range(1, len(EXAMPLES) + 1)) and len(EXAMPLES) >= 15
    assert all(re.fullmatch(r"\d\d_[a-z_]+", path.stem) for path in EXAMPLES)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_has_the_form_of_a_page(path):
    """A title, an introduction, then blocks of prose (comments) and of code by turns; tutorials are made of them."""
    text = path.read_text(encoding="utf-8")
    title, blank, *introduction = ast.get_docstring(ast.parse(text)).split("\n")
    assert title and not title.endswith(".") and not blank and any(introduction)
    lines = text.split("\n")
    assert 40 <= len(lines) - 1 <= 110 and max(map(len, lines)) <= 110
    # A block of prose stands alone: between blank lines, and never beside code.
    prose = [line.startswith("#") for line in lines]
    for (a, b), (is_prose_a, is_prose_b) in zip(pairwise(lines), pairwise(prose)):
        assert is_prose_a == is_prose_b or not a or not b, f"prose beside code: {a!r}, {b!r}"
    assert sum(prose) >= 6
    imports = [node for node in ast.parse(text).body if isinstance(node, ast.Import | ast.ImportFrom)]
    exec(compile(ast.Module(imports, []), path.name, "exec"), {})  # names that are there
    asserts = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Assert)]
    assert len(asserts) >= 4, "each step shows what was learned"
