"""Every example runs by itself, as a reader starts it: its own asserts are the checks of what it says."""

import ast
import os
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "examples"
EXAMPLES = sorted(FOLDER.glob("*.py"))
LONGEST_S = 300
"""With kernels that are not compiled yet; each takes a few seconds with them."""


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs(path, tmp_path):
    here, out = tmp_path / "here", tmp_path / "out"
    here.mkdir()
    own = {"PYTHONOPTIMIZE": "", "PYTHONWARNINGS": "error::DeprecationWarning:__main__"}
    done = subprocess.run(
        [sys.executable, str(path), str(out)],
        cwd=here,
        env=os.environ | own,
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.strip()
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
    asserts = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Assert)]
    assert len(asserts) >= 4, "each step shows what was learnt"
