"""Names of a camera's images: by their start, or by a pattern with wildcards."""

from __future__ import annotations

import re
from dataclasses import dataclass

from epipole._checks import checked

_WILDCARD = re.compile(r"([*?])")


@dataclass(frozen=True, slots=True)
class NamePattern:
    """Start of image names, or a pattern with the wildcards * (any text) and ? (any character)."""

    text: str
    has_wildcards: bool = False
    """Whether * and ? in the text are wildcards, and the text describes the whole name."""

    @checked
    def rest_of(self, name: str) -> tuple[str, ...] | None:
        """What the pattern leaves open: the text after the prefix, or that of each wildcard; None if the name does not match.

        A pattern without a slash describes the file name only; the folder is part of the rest.
        """
        if not self.has_wildcards:
            return (name[len(self.text) :],) if name.startswith(self.text) else None
        folder, slash, file_name = name.rpartition("/")
        if "/" in self.text:
            folder, slash, file_name = "", "", name
        parts = [{"*": "(.*)", "?": "(.)"}.get(part, re.escape(part)) for part in _WILDCARD.split(self.text)]
        found = re.fullmatch("".join(parts), file_name, re.DOTALL)
        return None if found is None else (folder + slash, *found.groups())

    @property
    def num_wildcards(self) -> int:
        """Number of wildcards."""
        return len(_WILDCARD.findall(self.text)) if self.has_wildcards else 0

    @property
    def num_fixed(self) -> int:
        """Number of characters that are not left open: of two matching patterns, the one with more is meant."""
        return len(self.text) - self.num_wildcards

    @property
    def in_words(self) -> str:
        """For messages."""
        return f"pattern {self.text!r}" if self.has_wildcards else f"prefix {self.text!r}"
