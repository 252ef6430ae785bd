"""Which pictures of a left and a right folder belong together."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from epipole.errors import FileFormatError
from epipole.io.photographs import list_photographs

_SIDE = re.compile(r"left|right|cam[01]|infra[12]|image_[01]")
_ENOUGH = 0.5  # of the names of the smaller folder: a chance agreement of a few does not pair the rest


def pair_folders(left: Path, right: Path, ignore: Sequence[Path] = ()) -> list[tuple[str, tuple[Path, Path]]]:
    """(name, (left picture, right picture)) by names where these agree but for the side's word, else by order.

    A picture without a partner keeps the path at which that was looked for: who reads it learns that there is none.

    Raises:
        FileFormatError: a folder has no picture, or nothing says which belong together.
    """
    names = [list_photographs(folder, ignore=list(ignore)).names for folder in (left, right)]
    for folder, own in ((left, names[0]), (right, names[1])):
        if not own:
            raise FileFormatError(folder, "there is no picture in it")
    keys = [{_SIDE.sub("*", name.lower()): name for name in own} for own in names]
    common = keys[0].keys() & keys[1].keys()
    unique = all(len(own) == len(key) for own, key in zip(names, keys))
    if unique and len(common) >= _ENOUGH * min(len(own) for own in names):
        every = [
            (keys[0].get(k, keys[1].get(k, "")), keys[1].get(k, keys[0].get(k, "")))
            for k in {**keys[0], **keys[1]}
        ]
    elif len(names[0]) == len(names[1]):
        every = list(zip(*names))
    else:
        raise FileFormatError(
            right,
            f"its {len(names[1])} names differ from the {len(names[0])} of {left}: which belong together?",
        )
    return sorted((a, (left / a, right / b)) for a, b in every)
