"""The job: a model written in another format."""

from __future__ import annotations

from pathlib import Path

from epipole._checks import as_path
from epipole.io.colmap import find_model
from epipole.io.convert import convert_model


def convert(source: str | Path, target: str | Path, format: str) -> Path:
    """Write a model, or that of a reconstruction's output folder, in another format; all else as `io.convert_model`.

    Raises:
        EpipoleError: as it does.
    """
    source, target = as_path(source), as_path(target)
    return convert_model(source if source.is_file() else find_model(source), target, format)
