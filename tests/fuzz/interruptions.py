"""Jobs that are killed, or find the disk full, at any of their file operations; and what the next run makes of it.

    python -m tests.fuzz.interruptions                          # every job, every file operation
    python -m tests.fuzz.interruptions --job undistort --every 5
    python -m tests.fuzz.interruptions --points 3               # every job, at three of its file operations
    python -m tests.fuzz.interruptions --random 100             # and killed at random moments, with two threads

After kill -9 the same command must end with the files that it makes without one, and leave nothing else. With a full
disk it must say so in one sentence, and the same command must finish once there is room again.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tests.board_pictures import board_pictures

from epipole import api
from epipole.errors import EpipoleError
from epipole.io.images.photographs import write_jpeg_with_exif
from epipole.pipelines.stereo.config import StereoConfig
from epipole.pipelines.stereo.run import stereo_many
from epipole.runs import thread_scope
from epipole.scene import RectifiedRig
from epipole.synthetic import courtyard, courtyard_views, render
from epipole.synthetic.stereo_rooms import stereo_room

CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.truncate", "sqlite3.connect")
"""Audit events of the interpreter that change files, beside `open` for writing."""
WITH_TIMES = ("epipole.json", "summary.json", "report.html", "frames.csv")
"""Files that hold times, which differ from run to run."""
ALL_WELL, SAID_WHY, CRASHED = 0, 3, 4
THREADS: dict[str, Any] = {"threads": 1, "executor": "inline"}
"""Of this process; children are forked, and threads that wait would be missing there."""


@dataclass(frozen=True)
class Job:
    """Something to interrupt."""

    prepare: Callable[[Path], None]
    run: Callable[[Path], object]
    out: str
    """The output, below the folder that both are called with."""


def _photographs(folder: Path) -> None:
    from epipole.cameras import Camera, CameraModel

    camera = Camera(CameraModel.PINHOLE, 360, 240, np.array([300.0, 300.0, 179.5, 119.5]))
    views = courtyard_views(24)[np.arange(6, 10)]
    (folder / "photographs").mkdir(parents=True)
    for n in range(len(views)):
        rgb = render(courtyard(), camera, views[n], noise_sigma=1.0, seed=n).rgb
        write_jpeg_with_exif(folder / "photographs" / f"view_{n}.jpg", rgb, focal_35mm=30.0)


def _model(folder: Path) -> None:
    shutil.copytree(_reconstructed().name, folder, copy_function=shutil.copy2)


@cache
def _reconstructed() -> tempfile.TemporaryDirectory[str]:
    """Made once; it is removed when this process ends."""
    made = tempfile.TemporaryDirectory()
    _photographs(Path(made.name))
    _reconstruct(Path(made.name))
    return made


def _reconstruct(folder: Path) -> object:
    config = api.ReconstructConfig(single_camera=True, **THREADS)
    return api.reconstruct(folder / "photographs", folder / "out", config)


def _pairs(folder: Path) -> None:
    room = stereo_room(8, (160, 120))
    for side, image in (("left", room.left), ("right", room.right)):
        (folder / side).mkdir(parents=True)
        for name in ("a.jpg", "b.jpg"):
            write_jpeg_with_exif(folder / side / name, np.stack([image] * 3, axis=2))


def _stereo(folder: Path) -> object:
    rig = RectifiedRig(200.0, 80.0, 60.0, 0.1)
    config = StereoConfig(max_disparity_px=32)
    return stereo_many(folder / "left", folder / "right", folder / "out", config, rig)


def _calibrate(folder: Path) -> object:
    return api.calibrate(folder / "IMAGES", folder / "out", columns=9, rows=6, square=0.025)


def _ride(folder: Path) -> None:
    from epipole.cameras import Camera, CameraModel
    from epipole.geometry import Rigid3

    camera = Camera(CameraModel.PINHOLE, 240, 180, np.array([200.0, 200.0, 119.5, 89.5]))
    step = Rigid3(np.eye(3), np.array([-0.12, 0.0, 0.0]))
    for side in ("image_0", "image_1"):
        (folder / "ride" / side).mkdir(parents=True)
    position = courtyard_views(24)[6]
    for n in range(4):
        for side in ("image_0", "image_1"):  # the second camera stands where the first will be next
            seen = position if side == "image_0" else step @ position
            cv2.imwrite(str(folder / "ride" / side / f"{n}.png"), render(courtyard(), camera, seen).rgb)
        position = step @ position
    rows = [[200, 0, 119.5, x, 0, 200, 89.5, 0, 0, 0, 1, 0] for x in (0, -24)]
    text = "".join(f"P{k}: {' '.join(map(str, row))}\n" for k, row in enumerate(rows))
    (folder / "ride" / "calib.txt").write_text(text)


def _slam(folder: Path) -> object:
    with thread_scope(THREADS["threads"], opencv_alone=True):
        return api.slam(folder / "ride", folder / "out", resume=True)


JOBS = {
    "slam": Job(_ride, _slam, "out"),
    "reconstruct": Job(_photographs, _reconstruct, "out"),
    "undistort": Job(_model, lambda folder: api.undistort(folder / "out"), "out"),
    "transforms": Job(
        _model, lambda folder: api.convert(folder / "out", folder / "nerf", "transforms"), "nerf"
    ),
    "ply": Job(_model, lambda folder: api.convert(folder / "out", folder / "ply" / "a.ply", "ply"), "ply"),
    "stereo": Job(_pairs, _stereo, "out"),
    "calibrate": Job(lambda folder: board_pictures(folder, 6), _calibrate, "out"),
}


class Trials:
    """Interrupts one job at a time, in children of this process, which has loaded what they need."""

    def __init__(self, name: str, folder: Path) -> None:
        self.job, self.prepared = JOBS[name], folder / "prepared"
        self.position = folder / "trial"  # of the same name each time: paths stand in results
        self.job.prepare(self.prepared)
        shutil.copytree(self.prepared, self.position, copy_function=shutil.copy2)
        start = time.perf_counter()
        self.job.run(self.position)
        self.seconds = time.perf_counter() - start
        self.expected = tree(self.position / self.job.out)
        self.num_operations = self._count()

    def kill(self, operation: int) -> list[str]:
        """Kill the job at a file operation (the first is 1), do it again, and return what is wrong with the result."""
        self._set_up()
        ended = self._in_child(operation, lambda: os.kill(os.getpid(), signal.SIGKILL))
        if ended != -signal.SIGKILL:
            return [f"it was not killed, but ended with {ended}"]
        return self._do_again()

    def fill(self, operation: int) -> list[str]:
        """From a file operation on no file can grow; then do the job again, and return what was wrong."""
        self._set_up()
        ended = self._in_child(operation, _fill_the_disk)
        wrong = [] if ended in (SAID_WHY, ALL_WELL) else [f"on a full disk it ended with {ended}"]
        return [*wrong, *self._do_again()]

    def kill_at_random(self, seed: int) -> list[str]:
        """Kill the job, which works with threads, at some moment, and do it again."""
        self._set_up()
        after_s = random.Random(seed).uniform(0.0, self.seconds)
        child = self._fork(lambda: _interrupt_after(after_s), num_threads=2)
        os.waitpid(child, 0)
        return self._do_again()

    def spread(self, count: int) -> list[tuple[Callable[[int], list[str]], int]]:
        """So many operations, evenly spread; killed and out of space by turns."""
        operations = [self.num_operations * (2 * k + 1) // (2 * count) + 1 for k in range(count)]
        return [((self.kill, self.fill)[k % 2], n) for k, n in enumerate(operations)]

    def _set_up(self) -> None:
        shutil.rmtree(self.position)
        shutil.copytree(self.prepared, self.position, copy_function=shutil.copy2)

    def _do_again(self) -> list[str]:
        ended = self._in_child(0, lambda: None)
        if ended != ALL_WELL:
            return [f"the next run ended with {ended}"]
        found = tree(self.position / self.job.out)
        missing, new = self.expected.keys() - found.keys(), found.keys() - self.expected.keys()
        differ = [n for n in found.keys() & self.expected.keys() if found[n] != self.expected[n]]
        groups = {"missing": missing, "left behind": new, "different": differ}
        return [f"{what}: {', '.join(sorted(names)[:5])}" for what, names in groups.items() if names]

    def _count(self) -> int:
        self._set_up()
        reading, writing = os.pipe()
        with os.fdopen(reading) as result:
            self._in_child(0, lambda: None, writing)
            os.close(writing)
            return int(result.read())

    def _in_child(self, operation: int, act: Callable[[], None], report_to: int | None = None) -> int:
        """Exit code of the job done in a child, or -9 if it was killed."""
        child = self._fork(lambda: _interrupt(self.position, operation, act), report_to)
        status = os.waitpid(child, 0)[1]
        return -os.WTERMSIG(status) if os.WIFSIGNALED(status) else os.WEXITSTATUS(status)

    def _fork(
        self, prepare: Callable[[], Callable[[], int]], report_to: int | None = None, num_threads: int = 1
    ) -> int:
        """Do the job in a child; its process id."""
        if child := os.fork():
            return child
        try:
            count = prepare()
            THREADS.update(threads=num_threads, executor="inline" if num_threads == 1 else "threads")
            self.job.run(self.position)
            if report_to is not None:
                os.write(report_to, f"{count()}".encode())
            os._exit(ALL_WELL)
        except EpipoleError as error:
            is_clear = "cannot" in str(error) and ".part" not in str(error)
            os._exit(SAID_WHY if is_clear else CRASHED)
        except BaseException:  # noqa: BLE001 - the child ends here, whatever it was
            traceback.print_exc()
            os._exit(CRASHED)


def tree(root: Path) -> dict[str, str]:
    """Digest of every file below a folder."""
    files = sorted(p for p in root.rglob("*") if not p.is_dir())
    return {
        p.relative_to(root).as_posix(): ""
        if p.name in WITH_TIMES
        else hashlib.blake2b(p.read_bytes()).hexdigest()
        for p in files
    }


def _interrupt(root: Path, operation: int, act: Callable[[], None]) -> Callable[[], int]:
    """Act at a file operation below a folder, in this process; returns what counts them."""
    seen = 0
    inside = os.fspath(root)

    def watch(event: str, arguments: tuple[object, ...]) -> None:
        nonlocal seen
        if event == "socket.connect":  # nothing is sent anywhere
            os._exit(CRASHED)
        writes = (
            event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
        )
        if (writes or event in CHANGES) and inside in str(arguments[0]):
            seen += 1
            if seen == operation:
                act()

    sys.addaudithook(watch)
    return lambda: seen


def _interrupt_after(seconds: float) -> Callable[[], int]:
    signal.signal(signal.SIGALRM, signal.SIG_DFL)  # which ends the process at once, as a kill does
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3))
    return lambda: 0


def _fill_the_disk() -> None:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))


def main() -> None:
    """Try every file operation of every job, or random moments."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--job", choices=JOBS, nargs="*", default=list(JOBS))
    parser.add_argument("--every", type=int, default=1, help="try every so-manieth operation")
    parser.add_argument("--points", type=int, default=0, help="instead, so many operations of each job")
    parser.add_argument("--random", type=int, default=0, help="instead, kill so many times at random moments")
    given = parser.parse_args()
    num_wrong = 0
    for name in given.job:
        with tempfile.TemporaryDirectory() as folder:
            trials = Trials(name, Path(folder))
            operations = range(1, trials.num_operations + 1, given.every)
            trial = [(what, n) for n in operations for what in (trials.kill, trials.fill)]
            if given.points:
                trial = trials.spread(given.points)
            if given.random:
                trial = [(trials.kill_at_random, seed) for seed in range(given.random)]
            for what, n in trial:
                for problem in what(n):
                    num_wrong += 1
                    print(f"{name}, {what.__name__} {n}: {problem}", flush=True)
            print(f"{name}: {trials.num_operations} file operations, {len(trial)} trials", flush=True)
    sys.exit(1 if num_wrong else 0)


if __name__ == "__main__":
    main()
