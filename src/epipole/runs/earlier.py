"""Earlier results in an output folder: continued by a run with other inputs, and not silently replaced with poorer ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from epipole.errors import FileFormatError, WorkspaceError
from epipole.io.files import read_json
from epipole.runs.folder import read_mark
from epipole.runs.guard import is_overwriting
from epipole.runs.source import Source

SUMMARY = "summary.json"


def continue_with(root: Path, kind: str, inputs: Sequence[Path], advice: Mapping[str, str]) -> None:
    """Let a run with other inputs continue the results in its output folder, such as a model that grows.

    Args:
        root: the output folder.
        kind: the command that continues its own results.
        inputs: its present files and folders.
        advice: by other commands: what to do instead.

    Raises:
        WorkspaceError: the results are of another command.
    """
    mark = read_mark(root)
    if mark is None:
        return
    if mark.kind != kind:
        raise WorkspaceError(
            f"{root} contains the results of `epipole {mark.kind}`, which cannot be continued"
            + (f": {advice[mark.kind]}" if mark.kind in advice else "")
        )
    mark.source = Source.of(inputs, root)
    mark.save()


def earlier_number(root: Path, name: str) -> float | None:
    """A number from the summary of an earlier run in an output folder; None if there is none."""
    if not (root / SUMMARY).is_file():
        return None
    try:
        value = read_json(root / SUMMARY)[name]
    except (FileFormatError, KeyError, TypeError, IndexError):
        return None
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def refuse_poorer(root: Path, name: str, number: int, words: str) -> None:
    """Raise if the new result is poorer than the earlier one.

    Args:
        root: the output folder, which belongs to the same job and source.
        name: key of the number in `summary.json`.
        number: the new result's number, or an upper bound of it.
        words: what is counted.

    Raises:
        WorkspaceError: the earlier result has more, and `--overwrite` was not passed.
    """
    earlier = earlier_number(root, name)
    if earlier is None or number >= earlier or is_overwriting():
        return
    raise WorkspaceError(
        f"{root} contains a result with {earlier:.0f} {words}, more than the {number} of this run, so it is not replaced: "
        "choose another output folder, or pass --overwrite"
    )


def note_on_poorer(root: Path, name: str, number: float, words: str) -> list[str]:
    """A warning if the new result is poorer than the earlier one that it replaces; empty if not."""
    earlier = earlier_number(root, name)
    if earlier is None or number >= earlier:
        return []
    return [
        f"the earlier result in {root} had {earlier:,g} {words}; the new one that replaces it has {number:,g}"
    ]
