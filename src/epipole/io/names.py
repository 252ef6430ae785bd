"""Names that stand in files, as paths inside one folder.

A model, a database or a manifest may come from anyone. What such a file calls an image is a path below the folder of
the images, or it is refused: read or written outside of it nothing is.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path, PurePath, PurePosixPath

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


def flat_names(names: Sequence[str]) -> list[str]:
    """One name for each image's file in a single folder, without its ending; no two are the same.

    The name is the image's without folders and ending, `b_c` of `b/c.png`. Images that would have the same (`a.png` and
    `a.jpg`; `b/c.png` and `b_c.png`; `A.png` and `a.png`, which some file systems take for one) keep their ending and
    are numbered where that is not enough.
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
    except (OSError, RuntimeError):  # links in a circle
        return False
