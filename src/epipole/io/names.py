"""Names that stand in files, as paths inside one folder.

A model, a database or a manifest may come from anyone. What such a file calls an image is a path below the folder of
the images, or it is refused: read or written outside of it nothing is.
"""

from __future__ import annotations

import os
from pathlib import Path, PurePath

from epipole.errors import FileFormatError


def is_inside_name(name: str) -> bool:
    """Whether a name is a relative path that stays below its folder, whatever the folder is."""
    path = PurePath(name)
    return bool(path.parts) and not path.anchor and ".." not in path.parts and "\0" not in name


def path_inside(root: Path, name: str) -> Path:
    """The path of a name below a folder.

    Args:
        root: the folder; need not exist.
        name: as it stands in a file, with slashes.

    Raises:
        FileFormatError: it is empty, absolute or climbs out (`..`), or leads out through a linked folder.
    """
    path = root / name if is_inside_name(name) else None
    # The last part may be a link, for photographs often are; a writer has to look at that itself.
    if path is None or not path.parent.resolve().is_relative_to(root.resolve()):
        raise FileFormatError(root, f"the name {os.fsencode(name)!r} leads out of this folder")
    return path
