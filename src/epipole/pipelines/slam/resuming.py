"""Taking up a run that was stopped: what it had followed, and what of the source is left."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from epipole._version import __version__
from epipole.errors import ConfigError, FileFormatError, NoModelError, WorkspaceError
from epipole.io.atomic import atomic_write, reporting
from epipole.io.files import read_json
from epipole.io.json_files import json_text
from epipole.pipelines.slam.checkpoint import Checkpoint
from epipole.pipelines.slam.config import JobOptions
from epipole.pipelines.slam.frames import Frame
from epipole.pipelines.slam.growing_path import GROWING
from epipole.pipelines.slam.journal import JOURNAL, Entry, read_journal
from epipole.pipelines.slam.record import FrameRecord
from epipole.pipelines.slam.restoring import Restored, go_on_after, read_state
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.slam_map import SlamMap
from epipole.pipelines.slam.source import FrameSource, QueuedFrame
from epipole.pipelines.slam.state_files import ARRAYS, STATE, StateFiles
from epipole.runs import digest

CHECKPOINT, KEY = "checkpoint", "key.json"
_OWN = (KEY, JOURNAL, GROWING, STATE, ARRAYS.format("*"))
_OUTSIDE = ("resume", "max_frames", "trajectory_format", "truth", "map", "view", "port", "host")
"""Options of the job that no answer depends on, or whose content is compared."""

Key = dict[str, str]
"""All that the answers depend on, by names."""


class TakenUp(NamedTuple):
    """A run where it stands."""

    checkpoint: Checkpoint
    records: list[FrameRecord]
    """Of the frames that were followed before."""
    source: FrameSource
    """With the frames that are left."""
    job: JobOptions
    """With as many frames as are left to be followed, and as many skipped before the next of them as `stride` says."""
    first_number: int
    """Of the source's frames, where they are counted anew."""
    num_dropped: int
    """Frames that were dropped before."""


def key_of(
    sketch: Sequence[str], source: FrameSource, system: Slam, job: JobOptions, known: SlamMap | None = None
) -> Key:
    """What a run is known by: another source, camera, map, version or option gives other answers.

    Args:
        sketch: of the source's files; not used for a camera, which has none.
        source: the frames.
        system: its options and inertial unit.
        job: options that answers depend on, and others.
        known: the map that is gone on in.
    """
    camera = source.camera
    lens, depth = camera.camera, camera.depth
    seen: list[Any] = [
        int(lens.model),
        lens.width,
        lens.height,
        lens.params,
        camera.baseline,
        camera.readout_s,
    ]
    if depth is not None:
        other, there = depth.camera, depth.depth_from_color
        seen += [int(other.model), other.width, other.height, other.params, depth.scale]
        seen += [there.rotation, there.translation]
    imu = system.imu
    own = {name: value for name, value in asdict(job).items() if name not in _OUTSIDE}
    return {
        "the version of epipole": __version__,
        "the source's files": "" if source.is_live else digest(*sketch),
        "the camera": digest(*seen),
        "the depth scale": str(source.about.get("depth_scale", "")),
        "the IMU's log": ""
        if imu is None
        else digest(imu.log.timestamp_s, imu.log.gyro_rad_s, imu.log.accel_m_s2),
        "the known map": "" if known is None else digest(known.xyz, [k.number for k in known.keyframes]),
        **{
            f"--{name.replace('_', '-')}": str(value)
            for name, value in _flat({**own, **asdict(system.config)})
        },
    }


def take_up(folder: Path, key: Key, system: Slam, source: FrameSource, job: JobOptions) -> TakenUp:
    """Go on with the run that was stopped in a folder, or begin one.

    A source whose frames can be read again is followed from the last state on, which gives the answers of a run that was
    not stopped. Of a camera, and in real time, the journal's answers stand, and the camera is sought in the map.

    Args:
        folder: of the checkpoint.
        key: of this run.
        system: SLAM before its first frame; it is given the state.
        source: all frames.
        job: whether a stopped run must be gone on with (`resume`), and how many frames are followed.

    Raises:
        ConfigError: the stopped run is of another source, or was made with other options.
        FileFormatError: what it left is damaged.
        WorkspaceError: the folder is not ours, or cannot be written.
    """
    can_repeat = not (source.is_live or job.realtime)
    found = None
    if _is_wanted(folder, key, job, can_repeat=can_repeat):
        try:
            found = _read(folder, system)
        except FileFormatError as error:
            if job.resume or not can_repeat:
                raise FileFormatError(folder, f"{error}; remove it to begin anew") from error
    if found is None:
        remove_checkpoint(folder)
        with reporting(folder):
            folder.mkdir(exist_ok=True)
        mark_checkpoint(folder, key, is_written=False)
        kept: Sequence[Entry] = ()
        checkpoint = Checkpoint(folder)
    else:
        kept = found.entries[: found.restored.num_lines] if can_repeat else found.entries
        if not can_repeat:
            missed = [entry.record.answer for entry in found.entries[found.restored.num_lines :]]
            go_on_after(found.restored.state, [answer for answer in missed if answer is not None])
        vars(system).update(found.restored.state)
        checkpoint = Checkpoint(folder, found.files)
    for entry in kept:
        system.loops.extend(entry.loops)
    records = [entry.record for entry in kept]
    left = _left(source, records, system, can_repeat=can_repeat)
    first = num_dropped = 0
    if records:
        last = records[-1].number
        num_dropped = max(0, (last - job.start) // job.stride + 1 - len(records))
        first = last + 1 if source.is_live else 0
        job = replace(job, start=job.stride - 1)
    checkpoint.begin(system, records, source.body_from_camera, kept[-1] if kept else None)
    if job.max_frames is not None:
        wanted = job.max_frames - len(records)
        left = left if wanted > 0 else replace(left, num_frames=0, frames=_nothing)
        job = replace(job, max_frames=max(wanted, 1))
    return TakenUp(checkpoint, records, left, job, first, num_dropped)


@contextmanager
def settled(folder: Path, key: Key, *, is_complete: bool) -> Iterator[None]:
    """Write the results in the block: afterwards a run that has come to its source's end is not gone on with.

    Raises:
        WorkspaceError: the folder is not writable.
    """
    no_model = None
    try:
        yield
    except NoModelError as error:  # there is nothing to write
        no_model = error
    if is_complete:
        remove_checkpoint(folder)
    else:
        mark_checkpoint(folder, key, is_written=True)
    if no_model is not None:
        raise no_model


def mark_checkpoint(folder: Path, key: Key, *, is_written: bool) -> None:
    """Say whose checkpoint it is, and whether the results of all its frames have been written.

    Raises:
        WorkspaceError: the folder is not writable.
    """
    with atomic_write(folder / KEY) as aside:
        aside.write_text(json_text({"key": key, "is_written": is_written}, indent=1), encoding="utf-8")


def remove_checkpoint(folder: Path) -> None:
    """Remove what a run has left, and the folder if it holds nothing else.

    Raises:
        WorkspaceError: it is no folder of ours.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise WorkspaceError(f"{folder} is no folder of epipole's: choose another output folder")
    if not folder.exists():
        return
    with reporting(folder, "remove the files in"):
        for pattern in _OWN:
            for path in folder.glob(pattern):
                path.unlink()
    with suppress(OSError):
        folder.rmdir()


def _is_wanted(folder: Path, key: Key, job: JobOptions, *, can_repeat: bool) -> bool:
    """Whether the folder holds a run that is gone on with.

    Raises:
        ConfigError: it holds one that is not this one, and must not be lost.
        FileFormatError: its key is damaged.
    """
    path = folder / KEY
    if not path.is_file() or not (folder / JOURNAL).is_file():
        return False
    try:
        held = read_json(path)
        before, is_written = dict(held["key"]), bool(held["is_written"])
    except (ValueError, KeyError, TypeError, OSError) as error:
        if not job.resume and can_repeat:
            return False
        raise FileFormatError(path, f"is damaged ({error}); remove {folder} to begin anew") from error
    if not job.resume and not can_repeat:
        if is_written:
            return False
        raise ConfigError(
            f"{folder} holds a path whose frames cannot be read again, of a run that was stopped: go on with --resume, "
            "or choose another output folder"
        )
    other = [name for name in {**before, **key} if before.get(name) != key.get(name)]
    if other and job.resume:
        told = [_difference(name, before.get(name), key.get(name)) for name in other]
        raise ConfigError(
            f"{folder} is of a run that this one cannot go on with: {'; '.join(told)}. Give what was given "
            "then, or leave --resume out to begin anew"
        )
    return not other


def _difference(name: str, then: str | None, now: str | None) -> str:
    if not name.startswith("--") and name != "the version of epipole":
        return f"{name} are others now" if name.endswith("files") else f"{name} is another now"
    return f"{name} was {then or 'not given'}, and is {now or 'not given'} now"


class _Found(NamedTuple):
    """What a stopped run has left."""

    entries: list[Entry]
    restored: Restored
    files: StateFiles


def _read(folder: Path, system: Slam) -> _Found | None:
    """What is there; None before the first state.

    Raises:
        FileFormatError: something is damaged.
    """
    if not (folder / STATE).is_file():
        return None
    files, entries = StateFiles(folder), read_journal(folder / JOURNAL)
    restored = read_state(system, files)
    count = restored.num_lines
    if not 0 <= count <= len(entries) or (count and entries[count - 1].end != restored.num_bytes):
        raise FileFormatError(folder / JOURNAL, f"lacks frames of the {count} that were followed")
    return _Found(entries, restored, files)


def _left(
    source: FrameSource, records: Sequence[FrameRecord], system: Slam, *, can_repeat: bool
) -> FrameSource:
    """The source from where it was left: after the last frame that was followed.

    Raises:
        ConfigError: its frames are not those that were followed.
    """
    if not records or source.is_live:
        return source
    last = records[-1].number
    frames = source.frames()
    newest = next((r.number for r in reversed(records) if r.answer is not None), -1)
    for record in records if can_repeat else ():
        queued = next((each for each in frames if each.number >= record.number), None)
        if queued is None or (queued.number, queued.name) != (record.number, record.name):
            raise ConfigError(f"frame {record.number} of the source is not {record.name}, which was followed")
        if record.number == newest and not _is_same(queued.read(), system):
            raise ConfigError(f"{record.name} is not the picture that was followed: the source has changed")
    if not can_repeat:
        for queued in frames:
            if queued.number == last:
                break
    num_left = max(source.num_frames - last - 1, 0)
    return replace(source, num_frames=num_left, frames=lambda: frames)


def _is_same(frame: Frame, system: Slam) -> bool:
    """Whether it is the last frame that SLAM has seen."""
    before: Frame | None = vars(system)["_before"]
    if before is None or frame.timestamp_s != before.timestamp_s:
        return False
    pairs = (
        (frame.grey, before.grey),
        (frame.right_grey, before.right_grey),
        (frame.depth, before.depth),
    )
    return all(
        (a is None) == (b is None)
        and (a is None or b is None or np.array_equal(a, b, equal_nan=a.dtype.kind == "f"))
        for a, b in pairs
    )


def _nothing() -> Generator[QueuedFrame, None, None]:
    yield from ()


def _flat(options: dict[str, Any], before: str = "") -> list[tuple[str, Any]]:
    """Options of options by names with a dot."""
    out: list[tuple[str, Any]] = []
    for name, value in options.items():
        own = f"{before}{name}"
        out += _flat(value, f"{own}.") if isinstance(value, dict) else [(own, value)]
    return out
