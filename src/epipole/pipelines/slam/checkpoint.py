"""What a run keeps on disk while it goes on, so that it can be taken up wherever it was killed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

from epipole.geometry import Rigid3
from epipole.pipelines.slam.growing_path import GrowingPath
from epipole.pipelines.slam.journal import Entry, Journal
from epipole.pipelines.slam.record import FrameRecord
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.state_files import StateFiles

SHARE, PAUSE_S, LONGEST_S = 0.03, 1.0, 30.0
"""The state is written every second; less often where the last one, or all, took a larger share of the time; but at least
every half minute."""


class Checkpoint:
    """The journal, the growing path and the state of a run in a folder."""

    def __init__(self, folder: Path, files: StateFiles | None = None) -> None:
        self.folder = folder
        self.files = StateFiles(folder) if files is None else files
        self.seconds = 0.0
        """Spent here so far."""
        self.num_states = 0
        self._begin_s = self._last_s = perf_counter()
        self._cost_s = 0.0
        self._is_urgent = files is None

    def begin(
        self,
        system: Slam,
        records: Sequence[FrameRecord],
        body_from_camera: Rigid3,
        last: Entry | None = None,
    ) -> None:
        """Go on after these frames, whose last one is this line of the journal.

        Raises:
            WorkspaceError: the files cannot be written.
        """
        self.journal = Journal(self.folder, last)
        self.path = GrowingPath(self.folder, body_from_camera)
        self._num_lines, self._num_loops = len(records), len(system.loops)
        self._tell_all(system, records)

    def add(self, system: Slam, records: Sequence[FrameRecord]) -> None:
        """Keep the last of the frames, and the state where it is time.

        Raises:
            WorkspaceError: the disk is full.
        """
        begin = perf_counter()
        answer, loops = records[-1].answer, system.loops[self._num_loops :]
        self.journal.add(records[-1], loops)
        self._num_lines, self._num_loops = self._num_lines + 1, len(system.loops)
        if _world_of(system) != self._world:
            self._tell_all(system, records)
        elif answer is not None:
            self.path.add(answer)
        # Without the first place, and after the world was bent, what the journal holds fits no state.
        is_placed = self._is_urgent and answer is not None and answer.world_from_body is not None
        is_bent = any(loop.verdict == "accepted" for loop in loops)
        now = perf_counter()
        self.seconds += now - begin
        pause_s = max(self._cost_s / SHARE, PAUSE_S)
        if self.seconds > SHARE * (now - self._begin_s):
            pause_s = LONGEST_S
        is_time = now - self._last_s >= min(pause_s, LONGEST_S)
        if is_time or is_placed or is_bent:
            self.keep(system)

    def keep(self, system: Slam) -> None:
        """Write the state.

        Raises:
            WorkspaceError: the disk is full.
        """
        begin = perf_counter()
        facts = {"num_lines": self._num_lines, "num_bytes": self.journal.num_bytes}
        self.files.write(vars(system), known_to(system), facts)
        self._last_s, self._is_urgent = perf_counter(), False
        self._cost_s = self._last_s - begin
        self.seconds += self._cost_s
        self.num_states += 1

    def close(self) -> None:
        """Close the files."""
        self.files.close()
        self.journal.close()
        self.path.close()

    def _tell_all(self, system: Slam, records: Sequence[FrameRecord]) -> None:
        """The path anew: frames before the world's first one are not in it."""
        self._world = _world_of(system)
        first, number = system.first_frame - system.first_number, system.maps[0].number
        tracked = [record.answer for record in records if record.answer is not None]
        self.path.begin([answer for answer in tracked[first:] if answer.map_number == number])


def _world_of(system: Slam) -> tuple[int, int]:
    """What changes where the first map begins anew."""
    return system.first_frame, system.maps[0].number


def known_to(system: Slam) -> dict[str, object]:
    """What is there before a state is read, and is not part of it."""
    return {
        **{"config": system.config, "sensor": system.camera, "lens": system.camera.camera},
        "ledger": system.loops,
        **({} if system.imu is None else {"imu": system.imu}),
    }
