"""epipole's structure from motion, run through its command line."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

from benchmarks.peers.base import Limits
from benchmarks.tasks.sfm import SfmTask


class EpipoleSfm:
    """`epipole reconstruct IMAGES OUT` in the environment of the benchmark, with `$EPIPOLE_NUM_THREADS` threads."""

    name = "epipole"
    needs = None

    def version(self) -> str | None:
        """The installed version; None if the command is not installed."""
        try:
            return metadata.version("epipole") if self._program().exists() else None
        except metadata.PackageNotFoundError:
            return None

    def command(self, task: SfmTask, out: Path, limits: Limits) -> list[str]:
        """The command line of one complete run."""
        known = []
        if task.camera_model is not None and task.camera_params is not None:
            params = ",".join(map(repr, task.camera_params))
            known = ["--camera-model", task.camera_model, "--camera-params", params]
        limit_options = [
            "--features.max-features",
            str(limits.max_num_features),
            "--features.max-size-px",
            str(limits.max_image_size),
        ]
        return [str(self._program()), "reconstruct", str(task.images), str(out), *known, *limit_options]

    @staticmethod
    def _program() -> Path:
        return Path(sys.executable).with_name("epipole")
