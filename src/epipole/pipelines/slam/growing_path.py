"""The path as it comes, in a file that can be read at any time."""

from __future__ import annotations

from collections.abc import Sequence
from io import FileIO
from pathlib import Path

from epipole.geometry import Rigid3, Rotation3
from epipole.io.atomic import atomic_write, reporting
from epipole.io.trajectories import exact_text
from epipole.pipelines.slam.frames import TrackedFrame

GROWING = "trajectory_causal.txt"
_HEADER = b"# timestamp tx ty tz qx qy qz qw\n"


def write_all(file: FileIO, data: bytes) -> None:
    """Write to a file without a buffer: a disk that is nearly full takes a part, and says so at the next.

    Raises:
        OSError: the disk is full.
    """
    left = memoryview(data)
    while left:
        left = left[file.write(left) :]


class GrowingPath:
    """TUM's form, a line for each frame that has a place when it comes."""

    def __init__(self, folder: Path, body_from_camera: Rigid3) -> None:
        self.path = folder / GROWING
        self._camera_from_body = body_from_camera.inverse()
        self._file: FileIO | None = None

    def begin(self, answers: Sequence[TrackedFrame]) -> None:
        """Write the file anew, in one step.

        Raises:
            WorkspaceError: it cannot be written.
        """
        self.close()
        with atomic_write(self.path) as aside:
            aside.write_bytes(_HEADER + self._lines(answers))
        with reporting(self.path):
            self._file = FileIO(self.path, "ab")

    def add(self, answer: TrackedFrame) -> None:
        """Add a frame.

        Raises:
            WorkspaceError: the disk is full.
        """
        assert self._file is not None
        line = self._lines([answer])
        if line:
            with reporting(self.path):
                write_all(self._file, line)

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _lines(self, answers: Sequence[TrackedFrame]) -> bytes:
        return b"".join(self._line(answer) for answer in answers if answer.world_from_body is not None)

    def _line(self, answer: TrackedFrame) -> bytes:
        assert answer.world_from_body is not None
        place = answer.world_from_body @ self._camera_from_body
        values = [*place.translation, *Rotation3(place.rotation).as_quat_wxyz()[[1, 2, 3, 0]]]
        return f"{answer.timestamp_s:.9f} {exact_text(values)}\n".encode()
