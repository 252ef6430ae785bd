"""What a finished reconstruction lost on its way, for the jobs that go on with its model."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from epipole.errors import FileFormatError
from epipole.io.files import read_json

SUMMARY = "summary.json"
REASONS_SHOWN = 5
"""Images that are named; the report lists all."""


def losses_in(workspace: Path) -> list[str]:
    """Warnings of an output folder of `reconstruct`: its own, and the images and models that `sparse/0` lacks.

    Args:
        workspace: the folder; one of another kind, or one of its models, has no warnings.
    """
    folders = [folder for folder in (workspace / "sparse").glob("[0-9]*") if folder.is_dir()]
    if not folders:
        return []
    try:
        summary = read_json(workspace / SUMMARY)
    except FileFormatError:
        summary = {}
    if isinstance(summary, dict) and isinstance(summary.get("not_registered"), dict):
        return losses_of(summary, workspace)
    return [_only_largest(len(folders), workspace)] if len(folders) > 1 else []


def losses_of(summary: Mapping[str, Any], workspace: Path | None) -> list[str]:
    """The same of the summary of a reconstruction, as `reconstruct` writes it.

    Args:
        summary: with `warnings`, `models` and `not_registered`.
        workspace: the output folder; None where it is not kept.
    """
    warnings, models = summary.get("warnings"), summary.get("models")
    out = [text for text in warnings if isinstance(text, str)] if isinstance(warnings, list) else []
    if isinstance(models, list) and len(models) > 1:
        out.append(_only_largest(len(models), workspace))
    reasons = summary["not_registered"]
    out += [f"{name} is in no model: {reason}" for name, reason in list(reasons.items())[:REASONS_SHOWN]]
    more = len(reasons) - REASONS_SHOWN
    if more > 0:
        images = "image is" if more == 1 else "images are"
        where = "" if workspace is None else f": {workspace / 'report.html'} lists them"
        out.append(f"{more} more {images} in no model{where}")
    return out


def _only_largest(num_models: int, workspace: Path | None) -> str:
    where = "the reconstruction" if workspace is None else str(workspace)
    return f"{where} has {num_models} models that do not connect, of which only the first (sparse/0) is used"
