"""What a poorer result says, or keeps."""

import json
from pathlib import Path

import pytest

from epipole.errors import WorkspaceError
from epipole.runs import overwriting
from epipole.runs.earlier import earlier_number, note_on_poorer, refuse_poorer


def summary(root: Path, content: object) -> Path:
    (root / "summary.json").write_text(content if isinstance(content, str) else json.dumps(content))
    return root


@pytest.mark.parametrize("content", ["", "[]", "3", {}, {"n": None}, {"n": "7"}, {"n": True}, "{"])
def test_what_is_no_number_is_none(content: object, tmp_path: Path) -> None:
    assert earlier_number(tmp_path, "n") is None
    summary(tmp_path, content)
    assert earlier_number(tmp_path, "n") is None
    refuse_poorer(tmp_path, "n", 0, "frames")


def test_less_is_refused_or_noted(tmp_path: Path) -> None:
    summary(tmp_path, {"n": 7})
    refuse_poorer(tmp_path, "n", 7, "frames")
    with pytest.raises(WorkspaceError, match="a result with 7 frames, more than the 6 of this run"):
        refuse_poorer(tmp_path, "n", 6, "frames")
    with overwriting():
        refuse_poorer(tmp_path, "n", 6, "frames")
    assert note_on_poorer(tmp_path, "n", 7, "frames") == []
    assert "had 7 frames; the new one that replaces it has 6" in note_on_poorer(tmp_path, "n", 6, "frames")[0]
