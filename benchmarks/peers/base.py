"""What every program compared must offer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from benchmarks.tasks.sfm import SfmTask


@dataclass(frozen=True, slots=True)
class Limits:
    """The same bounds for every program."""

    max_image_size: int = 3200
    max_num_features: int = 8192
    num_threads: int = 2


class SfmPeer(Protocol):
    """A program that turns images into a COLMAP model under `out/sparse`."""

    name: str
    needs: str | None
    """The peer whose run just before left `database.db`, which this one starts from; None: starts from images."""

    def version(self) -> str | None:
        """The installed version; None where it is not installed."""

    def command(self, task: SfmTask, out: Path, limits: Limits) -> list[str]:
        """The command line of one whole run, in a process of its own."""
