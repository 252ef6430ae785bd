"""The path as it comes, in a file that can be read at any time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

from epipole.geometry import Rigid3, Rotation3
from epipole.io.atomic import reporting
from epipole.pipelines.slam.frames import TrackedFrame

GROWING = "trajectory_causal.txt"
_HEADER = b"# timestamp tx ty tz qx qy qz qw\n"


class GrowingPath:
    """TUM's form, a line for each frame that has a place when it comes."""

    def __init__(self, folder: Path, body_from_camera: Rigid3) -> None:
        """Begin the file anew.

        Raises:
            WorkspaceError: it cannot be written.
        """
        self.path = folder / GROWING
        self._camera_from_body = body_from_camera.inverse()
        with reporting(self.path):
            self._file: BinaryIO = self.path.open("wb", buffering=0)
            self._file.write(_HEADER)

    def add(self, answers: Sequence[TrackedFrame]) -> None:
        """Add frames.

        Raises:
            WorkspaceError: the disk is full.
        """
        lines = [self._line(answer) for answer in answers if answer.world_from_body is not None]
        if lines:
            with reporting(self.path):
                self._file.write(b"".join(lines))

    def clear(self) -> None:
        """Take all out: the world has begun anew."""
        with reporting(self.path):
            self._file.truncate(len(_HEADER))
            self._file.seek(len(_HEADER))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _line(self, answer: TrackedFrame) -> bytes:
        assert answer.world_from_body is not None
        place = answer.world_from_body @ self._camera_from_body
        values = [*place.translation, *Rotation3(place.rotation).as_quat_wxyz()[[1, 2, 3, 0]]]
        return f"{answer.timestamp_s:.9f} {' '.join(f'{value:.9g}' for value in values)}\n".encode()
