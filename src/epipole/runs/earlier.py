"""The earlier result that a run is about to replace: a poorer one does not take its place unnoticed."""

from __future__ import annotations

from pathlib import Path

from epipole.errors import FileFormatError, WorkspaceError
from epipole.io.files import read_json
from epipole.runs.guard import is_overwriting

SUMMARY = "summary.json"


def earlier_number(root: Path, name: str) -> float | None:
    """A number of the summary that an earlier run left in an output folder; None where there is none."""
    if not (root / SUMMARY).is_file():
        return None
    try:
        value = read_json(root / SUMMARY)[name]
    except (FileFormatError, KeyError, TypeError, IndexError):
        return None
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def refuse_poorer(root: Path, name: str, number: int, words: str) -> None:
    """Keep the earlier result where the new one has less.

    Args:
        root: the output folder, which belongs to the same job and source.
        name: of the number in `summary.json`.
        number: that of the new result, or the most that it can have.
        words: what is counted.

    Raises:
        WorkspaceError: the earlier result has more, and `--overwrite` was not passed.
    """
    earlier = earlier_number(root, name)
    if earlier is None or number >= earlier or is_overwriting():
        return
    raise WorkspaceError(
        f"{root} holds a result with {earlier:.0f} {words}, more than the {number} of this run, and keeps it: "
        "choose another output folder, or pass --overwrite"
    )


def note_on_poorer(root: Path, name: str, number: float, words: str) -> list[str]:
    """A warning where the new result has less than the earlier one that it replaces; empty where it has not."""
    earlier = earlier_number(root, name)
    if earlier is None or number >= earlier:
        return []
    return [
        f"the earlier result in {root}, which this one replaces, had {earlier:,g} {words}; this one has {number:,g}"
    ]
