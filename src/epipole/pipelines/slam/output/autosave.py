"""What a run saves while it tracks: its trajectory so far and, where frames come only once, its answers and its map."""

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
"""Which run the folder belongs to."""
TRAJECTORY = "trajectory_causal.txt"
SAVED_MAP = "map-{}.npz"
"""With the map's number."""
MAX_TIME_FRACTION = 0.03
"""Of the run's time spent on saving the map."""
MIN_INTERVAL_S = 1.0
MAX_INTERVAL_S = 30.0
"""Between two saved maps, even if they take a larger fraction of the time."""
_HEADER = b"# timestamp tx ty tz qx qy qz qw\n"


class Autosave:
    """Files in the checkpoint folder, from which `resuming` continues a run.

    The trajectory and the answers get a line per frame, which reaches the operating system at once: a killed process loses
    none. The map is written in one step, from time to time, and whenever the world changes.

    Attributes:
        seconds: time spent here.
        num_maps_saved: how often the map was written.
    """

    def __init__(self, folder: Path, body_from_camera: Rigid3, *, can_repeat: bool) -> None:
        """Start in a folder that exists.

        Args:
            folder: of the checkpoint.
            body_from_camera: transforms the tracked poses into those of the written trajectory.
            can_repeat: whether the source can give its frames again: then only the trajectory is saved.
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
        """Write what is known of the frames that an earlier process tracked.

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
        """Save the last of the frames, and the map if it is time.

        Args:
            system: after this frame.
            records: of all frames.
            names: gives the names of the images of the main map's keyframes.

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
        """Write the main map, unless the frames can be repeated, or the map is empty or not to be changed.

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
        """Write the trajectory in the present world, in one step, and open it for the frames that follow."""
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
    """Remove what a run has saved, and the folder if it holds nothing else.

    Raises:
        WorkspaceError: it is not a folder that epipole made.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise WorkspaceError(f"{folder} is not a folder that epipole made: choose another output folder")
    if not folder.exists():
        return
    with reporting(folder, "remove the files in"):
        for pattern in (KEY, ANSWERS, TRAJECTORY, SAVED_MAP.format("*")):
            for path in folder.glob(pattern):
                path.unlink()
    with suppress(OSError):
        folder.rmdir()


def write_all(file: FileIO, data: bytes) -> None:
    """Write to an unbuffered file: a disk that is nearly full takes a part, and reports the error at the next write.

    Raises:
        OSError: the disk is full.
    """
    left = memoryview(data)
    while left:
        left = left[file.write(left) :]


def _world_of(system: Slam) -> tuple[int, int]:
    """Changes when the main map starts again."""
    return system.first_frame, system.maps[0].number
