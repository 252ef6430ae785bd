"""The job: a model written in another format."""

from __future__ import annotations

from pathlib import Path

from epipole._checks import as_path
from epipole.io.colmap import find_model
from epipole.io.convert import convert_model


def convert(source: str | Path, target: str | Path, format: str) -> Path:
    """Write a model in another format.

    Args:
        source: output folder of a reconstruction, a COLMAP model, or a transforms.json.
        target: a folder for txt and bin, else a file, or a folder in which the file gets its usual name.
        format: txt, bin, ply, transforms or bundler.

    Returns:
        What was written.

    Raises:
        ConfigError: unknown format, or one that cannot hold the cameras.
        FileFormatError: there is no readable model.
        WorkspaceError: the target cannot be written.
    """
    source, target = as_path(source), as_path(target)
    return convert_model(source if source.is_file() else find_model(source), target, format)
