"""The scripts and style sheets that go into the pages: files of the package, read once."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from functools import cache
from importlib import resources


@cache
def asset(name: str) -> str:
    """The text of a file of `assets/`."""
    return resources.files("epipole.report").joinpath("assets", name).read_text(encoding="utf-8")


def joined(names: Sequence[str]) -> str:
    """Several assets one after another, as one script or style sheet."""
    return "".join(asset(name) for name in names)


def content_hash(script: str) -> str:
    """What a page's policy calls a script by, so that the browser runs this one and no other."""
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"
