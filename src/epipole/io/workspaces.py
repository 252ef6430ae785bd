"""The folder that a finished model belongs to: with its images, its database, and its summary."""

from __future__ import annotations

from pathlib import Path

from epipole._checks import checked
from epipole.io.colmap.model import find_model

IMAGES, DATABASE = "images", "database.db"


@checked
def workspace_of_model(path: str | Path, *needed: str) -> Path | None:
    """The given folder or a parent of the model's folder, whichever has all needed files and folders; None if none does.

    Args:
        path: an output folder of `reconstruct`, or a COLMAP model in it or beside its images and database.
        *needed: names in the folder, such as `IMAGES` and `DATABASE`.

    Raises:
        FileFormatError: there is no model.
    """
    at = find_model(path).resolve()
    folders = (Path(path), at, at.parent, at.parent.parent)
    return next((folder for folder in folders if all((folder / name).exists() for name in needed)), None)
