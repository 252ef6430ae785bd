"""Checkpoints during tracking: the trajectory and, if the frames cannot be read again, tracking results and map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from io import FileIO
from pathlib import Path
from time import perf_counter

from epipole.errors import WorkspaceError
from epipole.geometry import Rigid3, Rotation3
from epipole.io.atomic import atomic_write, reporting
from epipole.io.trajectories.files import exact_text
from epipole.pipelines.slam.frames import TrackedFrame
from epipole.pipelines.slam.output.answer_log import ANSWERS, line_of
from epipole.pipelines.slam.output.map_file import write_slam_map
from epipole.pipelines.slam.output.record import FrameRecord
from epipole.pipelines.slam.slam import Slam

FOLDER = Path("checkpoint")
KEY = "key.json"
"""Identifies the run that the folder belongs to."""
TRAJECTORY = "trajectory_causal.txt"
SAVED_MAP = "map-{}.npz"
"""File name, with the number of the map."""
MAX_TIME_FRACTION = 0.03
"""Largest fraction of the run time spent on saving the map."""
MIN_INTERVAL_S = 1.0
MAX_INTERVAL_S = 30.0
"""The map is saved at least this often, even if that exceeds `MAX_TIME_FRACTION`."""
_HEADER = b"# timestamp tx ty tz qx qy qz qw\n"


class Autosave:
    """Writes the checkpoint files from which `resuming` continues a run.

    The trajectory and the log get one unbuffered line per frame, so that a killed process loses none. The map is written
    atomically, at intervals and whenever the world frame changes.

    Attributes:
        seconds: time spent on saving.
        num_maps_saved: how often the map was written.
    """

    def __init__(self, folder: Path, body_from_camera: Rigid3, *, can_repeat: bool) -> None:
        """Start in an existing folder.

        Args:
            folder: the checkpoint folder.
            body_from_camera: transforms the tracked poses into those of the written trajectory.
            can_repeat: whether the frames can be read again; if so, only the trajectory is saved.
        """
        self.folder, self.can_repeat = folder, can_repeat
        self.seconds, self.num_maps_saved = 0.0, 0
        self._camera_from_body = body_from_camera.inverse()
        self._trajectory: FileIO | None = None
        self._answers: FileIO | None = None
        self._world = (-1, -1)
        self._start_s = self._last_s = perf_counter()
        self._cost_s = 0.0

    def start(self, system: Slam, records: Sequence[FrameRecord]) -> None:
        """Write the results of the frames that an earlier process tracked.

        Raises:
            WorkspaceError: the files cannot be written.
        """
        self._write_trajectory(system, records)
        if self.can_repeat:
            return
        with atomic_write(self.folder / ANSWERS) as aside:
            aside.write_bytes(b"".join(map(line_of, records)))
        with reporting(self.folder / ANSWERS):
            self._answers = FileIO(self.folder / ANSWERS, "ab")

    def add(self, system: Slam, records: Sequence[FrameRecord], names: Callable[[], list[str]]) -> None:
        """Save the last frame, and the map if a save is due.

        Args:
            system: SLAM after this frame.
            records: records of all frames.
            names: returns the image names of the main map's keyframes.

        Raises:
            WorkspaceError: the disk is full.
        """
        start = perf_counter()
        answer = records[-1].answer
        if self._answers is not None:
            with reporting(self.folder / ANSWERS):
                write_all(self._answers, line_of(records[-1]))
        is_new_world = _world_of(system) != self._world
        if is_new_world:
            self._write_trajectory(system, records)
        elif answer is not None and answer.world_from_body is not None:
            assert self._trajectory is not None
            with reporting(self.folder / TRAJECTORY):
                write_all(self._trajectory, self._line(answer))
        self.seconds += perf_counter() - start
        if self._is_time(is_new_world or not self.num_maps_saved):
            self.save_map(system, names)

    def save_map(self, system: Slam, names: Callable[[], list[str]]) -> None:
        """Write the main map, unless the frames can be read again or the map is empty or fixed.

        Raises:
            WorkspaceError: the disk is full.
        """
        model = system.maps[0]
        if self.can_repeat or system.is_map_fixed or not model.num_points:
            return
        start = perf_counter()
        path = self.folder / SAVED_MAP.format(model.number)
        write_slam_map(path, model, names(), system.camera)
        for other in self.folder.glob(SAVED_MAP.format("*")):
            if other.name != path.name:
                with suppress(OSError):
                    other.unlink()
        self._last_s, self.num_maps_saved = perf_counter(), self.num_maps_saved + 1
        self._cost_s = self._last_s - start
        self.seconds += self._cost_s

    def close(self) -> None:
        """Close the files."""
        for file in (self._trajectory, self._answers):
            if file is not None:
                file.close()

    def _is_time(self, is_urgent: bool) -> bool:
        now = perf_counter()
        pause_s = max(self._cost_s / MAX_TIME_FRACTION, MIN_INTERVAL_S)
        if self.seconds > MAX_TIME_FRACTION * (now - self._start_s):
            pause_s = MAX_INTERVAL_S
        return is_urgent or now - self._last_s >= min(pause_s, MAX_INTERVAL_S)

    def _write_trajectory(self, system: Slam, records: Sequence[FrameRecord]) -> None:
        """Atomically write the trajectory in the current world frame, and open it for appending."""
        self._world = _world_of(system)
        tracked = [record.answer for record in records if record.answer is not None]
        own = tracked[system.first_frame - system.first_number :]
        lines = [
            self._line(answer)
            for answer in own
            if answer.world_from_body is not None and answer.map_number == self._world[1]
        ]
        if self._trajectory is not None:
            self._trajectory.close()
        path = self.folder / TRAJECTORY
        with atomic_write(path) as aside:
            aside.write_bytes(_HEADER + b"".join(lines))
        with reporting(path):
            self._trajectory = FileIO(path, "ab")

    def _line(self, answer: TrackedFrame) -> bytes:
        assert answer.world_from_body is not None
        pose = answer.world_from_body @ self._camera_from_body
        values = [*pose.translation, *Rotation3(pose.rotation).as_quat_wxyz()[[1, 2, 3, 0]]]
        return f"{answer.timestamp_s:.9f} {exact_text(values)}\n".encode()


def remove_checkpoint(folder: Path) -> None:
    """Remove the files of a checkpoint, and the folder if it is empty then.

    Raises:
        WorkspaceError: the path is not a folder that epipole created.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise WorkspaceError(f"{folder} was not created by epipole: choose another output folder")
    if not folder.exists():
        return
    with reporting(folder, "remove the files in"):
        for pattern in (KEY, ANSWERS, TRAJECTORY, SAVED_MAP.format("*")):
            for path in folder.glob(pattern):
                path.unlink()
    with suppress(OSError):
        folder.rmdir()


def write_all(file: FileIO, data: bytes) -> None:
    """Write everything to an unbuffered file: a nearly full disk takes a part and fails at the next write.

    Raises:
        OSError: the disk is full.
    """
    left = memoryview(data)
    while left:
        left = left[file.write(left) :]


def _world_of(system: Slam) -> tuple[int, int]:
    """Identifies the world frame, which changes when the main map is initialized again."""
    return system.first_frame, system.maps[0].number
