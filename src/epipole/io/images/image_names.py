"""Which files of a folder are meant: patterns on their names, and names that no text file can hold."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import PurePosixPath

from epipole._declared import checked

_BREAKS = frozenset({"Cc", "Zl", "Zp"})
_DEPTH_WORD = re.compile(r"depth", re.IGNORECASE)
_LETTERS = re.compile(r"[^\W\d_]+")
PAIRED_FRACTION = 0.4


@checked
def name_problem(name: str) -> str:
    """Why lists of images and COLMAP's files cannot hold a name; empty where they can.

    They are UTF-8 with one line per image.
    """
    try:
        name.encode()
    except UnicodeEncodeError:
        return "its name is not UTF-8; rename it"
    if any(unicodedata.category(c) in _BREAKS for c in name):
        return "its name has a line break or a control character; rename it"
    return ""


@checked
def printable(name: str) -> str:
    """A name with escapes for what cannot be printed."""
    shown = "".join(c.encode("unicode_escape").decode() if _is_odd(c) else c for c in name)
    return shown.encode(errors="backslashreplace").decode()


def _is_odd(character: str) -> bool:
    return unicodedata.category(character) in _BREAKS


@checked
def fits(name: str, pattern: str) -> bool:
    """Whether a relative name, or the file's own name where the pattern has no slash, fits a glob pattern."""
    return fnmatchcase(name, pattern) or (
        "/" not in pattern and fnmatchcase(PurePosixPath(name).name, pattern)
    )


@checked
def depth_among(names: Sequence[str], deep_grey: frozenset[str]) -> list[str]:
    """Those of the 16-bit grey PNGs that are the depth of the colour images beside them, by their names.

    A camera can well give 16-bit grey images. They are depth where there are colour images, too, and the name
    says "depth", or where each (two fifths of all images at least) has a colour image whose name is the same but
    for letters: `rgb/12.png` and `raw/12.png`.

    Args:
        names: of all images.
        deep_grey: those that are 16-bit grey PNGs.
    """
    others = {_without_letters(name) for name in names if name not in deep_grey}
    if len(names) - len(deep_grey) < 2:
        return []
    named = [name for name in names if name in deep_grey and _DEPTH_WORD.search(name)]
    paired = [name for name in names if name in deep_grey and _without_letters(name) in others]
    if len(paired) == len(deep_grey) >= PAIRED_FRACTION * len(names):
        return paired
    return named


def _without_letters(name: str) -> str:
    path = PurePosixPath(name)
    return _LETTERS.sub("", str(path.with_suffix("") if path.name else path))
