"""Images and models lost by a reconstruction, as warnings for commands that continue from it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from epipole.errors import FileFormatError
from epipole.io.files import read_json

SUMMARY = "summary.json"
REASONS_SHOWN = 5
"""Number of images that are named; the report lists all."""


def losses_in(workspace: Path) -> list[str]:
    """Warnings about an output folder of `reconstruct`: its own, and the images and models missing from `sparse/0`.

    Args:
        workspace: the folder; other folders have no warnings.
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
    """Warnings from a reconstruction's summary, as written by `reconstruct`.

    Args:
        summary: with the keys `warnings`, `models` and `not_registered`.
        workspace: the output folder; None if it is not kept.
    """
    warnings, models = summary.get("warnings"), summary.get("models")
    out = [text for text in warnings if isinstance(text, str)] if isinstance(warnings, list) else []
    if isinstance(models, list) and len(models) > 1:
        out.append(_only_largest(len(models), workspace))
    reasons = summary["not_registered"]
    out += [f"{name} is not registered: {reason}" for name, reason in list(reasons.items())[:REASONS_SHOWN]]
    more = len(reasons) - REASONS_SHOWN
    if more > 0:
        images = "image is" if more == 1 else "images are"
        where = "" if workspace is None else f": {workspace / 'report.html'} lists them"
        out.append(f"{more} more {images} in no model{where}")
    return out


def _only_largest(num_models: int, workspace: Path | None) -> str:
    where = "the reconstruction" if workspace is None else str(workspace)
    return f"{where} has {num_models} disconnected models; only the first (sparse/0) is used"
