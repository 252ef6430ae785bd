"""3D vision from images: cameras, features, two-view geometry, structure-from-motion, stereo, SLAM, radiance fields.

`epipole.reconstruct(images, out)` makes a 3D model of a folder of photographs; every other job is one call, too.
Everything is imported on first use: `import epipole` loads and compiles nothing. `api.py` lists the names.
"""

import re
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from epipole._version import __version__ as __version__

if TYPE_CHECKING:
    from epipole.api import *  # noqa: F403 - the names below, for editors and type checkers


@cache
def _public_names() -> list[str]:
    """What `api.py` imports by name, without importing it."""
    text = Path(__file__).with_name("api.py").read_text(encoding="utf-8")
    return re.findall(r"^from \S+ import \w+ as (\w+)$", text, re.MULTILINE)


def __getattr__(name: str) -> Any:
    if name == "__all__":
        return [*_public_names(), "__version__"]
    if name in _public_names():
        return getattr(import_module("epipole.api"), name)
    folder = Path(__file__).parent
    if not name.startswith("_") and ((folder / name).is_dir() or (folder / f"{name}.py").is_file()):
        return import_module(f"epipole.{name}")
    raise AttributeError(f"module 'epipole' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*_public_names(), "__version__"])
