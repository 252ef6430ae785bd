"""What a worker of a cluster does: it runs a chunk of units."""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from epipole._version import __version__
from epipole.errors import WorkspaceError
from epipole.io.atomic import atomic_write
from epipole.runs.payloads import with_paths
from epipole.runs.units import Unit, do_unit_as_worker

_writing = threading.Lock()


@dataclass(frozen=True, slots=True, eq=False)
class RemoteFile:
    """Content of a file. A type that Dask knows nothing of: it moves the bytes and does not look at them."""

    content: bytes

    def __sizeof__(self) -> int:
        return len(self.content) + 64


def run_chunk(
    version: str, units: tuple[Unit, ...], names: Sequence[str], files: Sequence[RemoteFile], is_shared: bool
) -> list[bytes | None]:
    """Run units one after the other; returns the content of each result, None if the folder is shared.

    Args:
        version: version of epipole that sends the units.
        units: with absolute paths.
        names: paths of the files that they read, if the folder is not shared.
        files: their contents.
        is_shared: whether the paths are those of a folder that all machines see.

    Raises:
        WorkspaceError: this is another version of epipole.
    """
    if version != __version__:
        raise WorkspaceError(
            f"a worker has epipole {__version__}, but its work comes from {version}: install the same version on every machine"
        )
    if is_shared:
        for unit in units:
            do_unit_as_worker(unit)
        return [None] * len(units)
    root = _own_folder()
    for name, file in zip(names, files):
        _keep(_below(root, Path(name)), file.content)
    out: list[bytes | None] = []
    for unit in with_paths(units, lambda path: _below(root, path)):
        do_unit_as_worker(unit)
        out.append(unit.path.read_bytes())
    return out


def _own_folder() -> Path:
    """A folder of this worker, which Dask removes with the worker."""
    from distributed import get_worker

    return Path(get_worker().local_directory) / "epipole"


def _below(root: Path, path: Path) -> Path:
    """An absolute path, inside the worker's folder."""
    return root.joinpath(*Path(os.path.normpath(path)).parts[1:])


def _keep(path: Path, content: bytes) -> None:
    """Write a file unless it has this content: other threads of the worker may be reading it."""
    with _writing:
        if path.is_file() and path.stat().st_size == len(content) and path.read_bytes() == content:
            return
        with atomic_write(path) as aside:
            aside.write_bytes(content)
