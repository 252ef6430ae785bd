"""Safe relative paths from file names in untrusted files.

A model, a database or a manifest may come from anyone. Image names in such files must be paths below the image folder;
others are rejected, so that nothing outside that folder is read or written.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path, PurePath, PurePosixPath

from epipole.errors import FileFormatError

LONGEST_NAME = 255
"""Longest file name in bytes, without folders, on common file systems."""


def is_inside_name(name: str) -> bool:
    """Whether a name is a relative path that stays below any folder it is joined to."""
    path = PurePath(name)
    if not path.parts or path.anchor or ".." in path.parts or "\0" in name:
        return False
    try:
        return all(len(os.fsencode(part)) <= LONGEST_NAME for part in path.parts)
    except UnicodeEncodeError:  # a lone surrogate, which JSON can contain
        return False


def path_inside(root: Path, name: str) -> Path:
    """Join a name from a file to a folder.

    Args:
        root: the folder; need not exist.
        name: as written in the file, with slashes.

    Raises:
        FileFormatError: the name is empty, absolute, too long, contains `..`, or leaves the folder through a symlink.
    """
    if not is_inside_name(name):
        raise FileFormatError(root, f"{name!a} does not name a file inside this folder")
    # The file itself may be a link, as photographs often are; writers check that themselves.
    if not _is_below(root, (root / name).parent):
        raise FileFormatError(
            root,
            f"{name!a} does not name a file inside this folder: a symbolic link leads out of it"
            " (copy the linked folder here, or pass the folder that it points to)",
        )
    return root / name


def flat_names(names: Sequence[str]) -> list[str]:
    """Unique file names without suffix for images in a single flat folder.

    The name is the image's path without suffix, with `_` for slashes: `b_c` for `b/c.png`. Images whose names would
    collide (`a.png` and `a.jpg`; `b/c.png` and `b_c.png`; `A.png` and `a.png`, which are the same on some file systems)
    keep their suffix, and get a number if that is not enough.
    """
    short = [str(PurePosixPath(name).with_suffix("")).replace("/", "_") for name in names]
    count: dict[str, int] = {}
    for each in short:
        count[each.casefold()] = count.get(each.casefold(), 0) + 1
    taken = {each for each, number in count.items() if number == 1}
    out = []
    for name, each in zip(names, short):
        if count[each.casefold()] > 1:
            each = _free_name(each + PurePosixPath(name).suffix, taken)
            taken.add(each.casefold())
        out.append(each)
    return out


def _free_name(wanted: str, taken: set[str]) -> str:
    name, number = wanted, 2
    while name.casefold() in taken:
        name, number = f"{wanted}_{number}", number + 1
    return name


def _is_below(root: Path, folder: Path) -> bool:
    try:
        return folder.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError):  # circular links
        return False
