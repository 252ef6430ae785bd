"""epipole itself, through its command line, as a user runs it."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

from benchmarks.peers.base import Limits
from benchmarks.tasks.sfm import SfmTask


class EpipoleSfm:
    """`epipole reconstruct IMAGES OUT` from the environment that runs the benchmark.

    The feature limit is the command's default; its threads come from `$EPIPOLE_NUM_THREADS`.
    """

    name = "epipole"
    needs = None

    def version(self) -> str | None:
        """The installed version; None where the command is not installed."""
        try:
            return metadata.version("epipole") if self._program().exists() else None
        except metadata.PackageNotFoundError:
            return None

    def command(self, task: SfmTask, out: Path, limits: Limits) -> list[str]:  # noqa: ARG002 - see the class
        """The command line of one whole run."""
        known = []
        if task.camera_model is not None and task.camera_params is not None:
            params = ",".join(map(repr, task.camera_params))
            known = ["--camera-model", task.camera_model, "--camera-params", params]
        return [str(self._program()), "reconstruct", str(task.images), str(out), *known]

    @staticmethod
    def _program() -> Path:
        return Path(sys.executable).with_name("epipole")
