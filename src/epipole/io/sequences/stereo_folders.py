"""Pairing of left and right images."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from epipole._checks import checked
from epipole.errors import FileFormatError
from epipole.io.images.photographs import list_photographs

_LEFT = re.compile(r"(?<![a-z])left(?![a-z])|(?<![a-z0-9])(?:cam0|infra1)(?![0-9])")
_RIGHT = re.compile(r"(?<![a-z])right(?![a-z])|(?<![a-z0-9])(?:cam1|infra2)(?![0-9])")
_OTHER = {"left": "right", "cam0": "cam1", "infra1": "infra2"}
_OTHER |= {there: here for here, there in _OTHER.items()}
_AGREES = 2  # number of common names; a single one may be chance

Pair = tuple[Path, Path]


@checked
def pair_folders(left: Path, right: Path, ignore: Sequence[Path] = ()) -> list[tuple[str, Pair]]:
    """Pairs (name, (left image, right image)), matched by name, by name without the side's word, or by order.

    An image without a partner is paired with the path where the partner was expected, so reading that path fails.

    Raises:
        FileFormatError: a folder has no images, both folders are the same, or the pairing is ambiguous.
    """
    listed = [list_photographs(folder, ignore=list(ignore)) for folder in (left, right)]
    if left.resolve() == right.resolve():
        raise FileFormatError(left, "the left and the right folder are the same")
    names = [own.require_some().names for own in listed]
    exact = set(names[0]) & set(names[1])
    if len(exact) >= min(_AGREES, *(-(-len(own) // 2) for own in names)):
        return [(name, (left / name, right / name)) for name in sorted({*names[0], *names[1]})]
    by_word = [_by_word(own, side) for own, side in zip(names, (_LEFT, _RIGHT))]
    all_have_one = all(len(keys) == len(own) for keys, own in zip(by_word, names))
    if all_have_one and by_word[0].keys() & by_word[1].keys():
        return _joined(by_word[0], by_word[1], left, right)
    if len(names[0]) != len(names[1]):
        raise FileFormatError(
            right,
            f"its {len(names[1])} image names do not match the {len(names[0])} in {left}: rename them so that pairs have the same name",
        )
    return [(a, (left / a, right / b)) for a, b in zip(*names)]


@checked
def pair_within(folder: Path) -> list[Pair]:
    """Pairs in one folder whose names differ in the side's word (left01.jpg and right01.jpg); empty if there are none.

    An image with the word but without a partner is paired with the path where the partner was expected.
    """
    names = list_photographs(folder).names
    sides = [_by_word(names, side) for side in (_LEFT, _RIGHT)]
    if not sides[0].keys() & sides[1].keys():
        return []
    return [pair for _, pair in _joined(sides[0], sides[1], folder, folder)]


@checked
def side_of(name: str, side: Literal["left", "right"]) -> str | None:
    """A name without the word for this side (left, cam0, infra1 ...), common to a pair; None without the word."""
    word = _LEFT if side == "left" else _RIGHT
    return word.sub("*", name.lower()) if word.search(name.lower()) else None


def _by_word(names: Sequence[str], side: re.Pattern[str]) -> dict[str, str]:
    return {side.sub("*", name.lower()): name for name in names if side.search(name.lower())}


def _joined(lefts: dict[str, str], rights: dict[str, str], left: Path, right: Path) -> list[tuple[str, Pair]]:
    out = []
    for key in sorted({*lefts, *rights}):
        one, two = lefts.get(key), rights.get(key)
        first, second = one or _for_other_side(two or ""), two or _for_other_side(one or "")
        out.append((first, (left / first, right / second)))
    return out


def _for_other_side(name: str) -> str:
    found = _LEFT.search(name.lower()) or _RIGHT.search(name.lower())
    if found is None:
        return name
    word = _OTHER[found.group()]
    return name[: found.start()] + word + name[found.end() :]
