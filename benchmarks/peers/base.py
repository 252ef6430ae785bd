"""Interface of the compared structure-from-motion programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from benchmarks.tasks.sfm import SfmTask


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits that are the same for every program."""

    max_image_size: int = 3200
    max_num_features: int = 8192
    num_threads: int = 2


class SfmPeer(Protocol):
    """A program that reconstructs images and writes a COLMAP model under `out/sparse`."""

    name: str
    needs: str | None
    """Name of the peer whose `database.db` this one starts from; None: it starts from the images."""

    def version(self) -> str | None:
        """The installed version; None if it is not installed."""

    def command(self, task: SfmTask, out: Path, limits: Limits) -> list[str]:
        """The command line of one complete run."""
