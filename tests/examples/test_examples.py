"""Every example runs as the main program, as a reader starts it: its own asserts are the checks of what it says."""

import ast
import json
import os
import re
import select
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from whole import IS_WHOLE

FOLDER = Path(__file__).resolve().parents[2] / "examples"
EXAMPLES = sorted(FOLDER.glob("*.py"))
LONGEST_S = 300
"""With kernels that are not compiled yet; each takes a few seconds with them."""


class Programs:
    """A process that runs examples one after the other; where all is tested, a new one for each."""

    def __init__(self) -> None:
        self.process: subprocess.Popen | None = None

    def close(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.communicate()
            self.process = None

    def __call__(self, path: Path, folder: Path, out: Path) -> tuple[bool, str]:
        if self.process is None:
            own = {"PYTHONOPTIMIZE": "", "PYTHONWARNINGS": "error::DeprecationWarning:__main__"}
            self.process = subprocess.Popen(
                [sys.executable, str(Path(__file__).with_name("example_process.py"))],
                env=os.environ | own,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(json.dumps([str(path), str(folder), str(out)]) + "\n")
        self.process.stdin.flush()
        is_ready, _, _ = select.select([self.process.stdout], [], [], LONGEST_S)
        line = self.process.stdout.readline() if is_ready else ""
        if IS_WHOLE or not line:
            self.close()
        assert line, f"{path.name} ended the process, or took more than {LONGEST_S} s"
        is_well, text = json.loads(line)
        return is_well, text


@pytest.fixture(scope="module")
def programs() -> Iterator[Programs]:
    made = Programs()
    yield made
    made.close()


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs(path, tmp_path, programs):
    here, out = tmp_path / "here", tmp_path / "out"
    here.mkdir()
    is_well, printed = programs(path, here, out)
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
    asserts = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Assert)]
    assert len(asserts) >= 4, "each step shows what was learnt"
