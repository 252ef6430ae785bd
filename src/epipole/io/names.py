"""Names that stand in files, as paths inside one folder.

A model, a database or a manifest may come from anyone. What such a file calls an image is a path below the folder of
the images, or it is refused: read or written outside of it nothing is.
"""

from __future__ import annotations

import os
from pathlib import Path, PurePath

from epipole.errors import FileFormatError

LONGEST_NAME = 255
"""Bytes of a file's name, without its folders, on the usual file systems."""


def is_inside_name(name: str) -> bool:
    """Whether a name is a relative path that stays below its folder, whatever the folder is."""
    path = PurePath(name)
    if not path.parts or path.anchor or ".." in path.parts or "\0" in name:
        return False
    try:
        return all(len(os.fsencode(part)) <= LONGEST_NAME for part in path.parts)
    except UnicodeEncodeError:  # half a character, as JSON may hold
        return False


def path_inside(root: Path, name: str) -> Path:
    """The path of a name below a folder.

    Args:
        root: the folder; need not exist.
        name: as it stands in a file, with slashes.

    Raises:
        FileFormatError: it is empty, absolute, too long or climbs out (`..`), or leads out through a linked folder.
    """
    if not is_inside_name(name):
        raise FileFormatError(root, f"{name!a} is no name of a file inside this folder")
    # The last part may be a link, for photographs often are; a writer has to look at that itself.
    if not _is_below(root, (root / name).parent):
        raise FileFormatError(
            root,
            f"{name!a} is no name of a file inside this folder, for a symbolic link leads out of it"
            " (copy the linked folder here, or give the folder that it points to)",
        )
    return root / name


def _is_below(root: Path, folder: Path) -> bool:
    try:
        return folder.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError):  # links in a circle
        return False
