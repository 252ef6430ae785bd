"""Checks and patterns for image names in a folder."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import PurePosixPath

from epipole._checks import checked

_BREAKS = frozenset({"Cc", "Zl", "Zp"})
_DEPTH_WORD = re.compile(r"depth", re.IGNORECASE)
_LETTERS = re.compile(r"[^\W\d_]+")
PAIRED_FRACTION = 0.4


@checked
def name_problem(name: str) -> str:
    """Why a name cannot be stored in image lists and COLMAP files (UTF-8, one line per image); empty if it can."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return "its name is not UTF-8; rename it"
    if any(unicodedata.category(c) in _BREAKS for c in name):
        return "its name has a line break or a control character; rename it"
    return ""


@checked
def printable(name: str) -> str:
    """A name with unprintable characters escaped."""
    shown = "".join(c.encode("unicode_escape").decode() if _is_odd(c) else c for c in name)
    return shown.encode(errors="backslashreplace").decode()


def _is_odd(character: str) -> bool:
    return unicodedata.category(character) in _BREAKS


@checked
def fits(name: str, pattern: str) -> bool:
    """Whether a relative name, or just the file name if the pattern has no slash, matches a glob pattern."""
    return fnmatchcase(name, pattern) or (
        "/" not in pattern and fnmatchcase(PurePosixPath(name).name, pattern)
    )


@checked
def depth_among(names: Sequence[str], deep_gray: frozenset[str]) -> list[str]:
    """Which of the 16-bit gray PNGs are depth images of the color images beside them, judged by their names.

    Some cameras produce 16-bit gray images. They are taken for depth if there are color images, too, and either the
    name contains "depth", or each one (and at least 40 % of all images) has a color image whose name differs only in
    letters: `rgb/12.png` and `raw/12.png`.

    Args:
        names: names of all images.
        deep_gray: those that are 16-bit gray PNGs.
    """
    others = {_without_letters(name) for name in names if name not in deep_gray}
    if len(names) - len(deep_gray) < 2:
        return []
    named = [name for name in names if name in deep_gray and _DEPTH_WORD.search(name)]
    paired = [name for name in names if name in deep_gray and _without_letters(name) in others]
    if len(paired) == len(deep_gray) >= PAIRED_FRACTION * len(names):
        return paired
    return named


def _without_letters(name: str) -> str:
    path = PurePosixPath(name)
    return _LETTERS.sub("", str(path.with_suffix("") if path.name else path))
