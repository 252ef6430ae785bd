"""Continue a run that was stopped.

If the frames can be read again (folders, videos, recordings), tracking starts again from the first one, with the result of an
undisturbed run. A live run keeps its saved results, and the camera is relocalized in the saved map.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

from epipole._version import __version__
from epipole.errors import ConfigError, FileFormatError, NoModelError
from epipole.io.atomic import atomic_write, reporting
from epipole.io.files import read_json
from epipole.io.json_files import json_text
from epipole.pipelines.slam.config import CameraOptions, JobOptions
from epipole.pipelines.slam.output.answer_log import ANSWERS, read_answers
from epipole.pipelines.slam.output.autosave import KEY, SAVED_MAP, Autosave, remove_checkpoint
from epipole.pipelines.slam.output.map_file import read_slam_map
from epipole.pipelines.slam.output.record import FrameRecord
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.sources.folder import FrameSource, QueuedFrame
from epipole.runs import digest

_FREE_OPTIONS = (
    "resume",
    "max_frames",
    "trajectory_format",
    "truth",
    "map",
    "record",
    "view",
    "port",
    "host",
)
"""Options that may differ when a run continues: tracking does not depend on them, or their content is compared."""

STARTED_AGAIN = (
    "the stopped run was started again from its first frame: the source's frames can be read again"
)

Key = dict[str, str]
"""Everything that tracking depends on, by name."""


class Continued(NamedTuple):
    """A run that starts or continues."""

    autosave: Autosave
    records: list[FrameRecord]
    """Records of the frames that an earlier process tracked."""
    source: FrameSource
    """Source of the remaining frames."""
    job: JobOptions
    """Options for the remaining frames."""
    first_number: int
    """Number of the source's next frame, if it counts from zero again."""
    num_dropped: int
    """Frames dropped by an earlier process."""
    notes: tuple[str, ...] = ()
    """Notes for the user."""


def key_of(fingerprint: Sequence[str], source: FrameSource, system: Slam, job: JobOptions) -> Key:
    """Key that identifies a live run by its source, camera, map, version and options.

    Args:
        fingerprint: fingerprint of the source's files; not used for a camera, which has none.
        source: source of the frames.
        system: SLAM with its camera, options and known map.
        job: options.
    """
    camera, depth = source.camera, source.camera.depth
    intrinsics = camera.camera
    seen: list[Any] = [
        int(intrinsics.model),
        intrinsics.width,
        intrinsics.height,
        intrinsics.params,
        camera.baseline,
        camera.readout_s,
    ]
    if depth is not None:
        other, pose = depth.camera, depth.depth_from_color
        seen += [int(other.model), other.width, other.height, other.params, depth.scale]
        seen += [pose.rotation, pose.translation]
    if camera.rig is not None:
        seen += [
            camera.rig.padded_params(),
            camera.rig.cam_from_rig.rotation,
            camera.rig.cam_from_rig.translation,
        ]
        seen += [number for own in camera.rig.cameras for number in (int(own.model), own.width, own.height)]
    known = [part for model in system.maps for part in (model.xyz, [k.number for k in model.keyframes])]
    free = {*_FREE_OPTIONS, *(each.name for each in fields(CameraOptions))}
    own = {name: value for name, value in asdict(job).items() if name not in free}
    return {
        "the version of epipole": __version__,
        "the source's files": "" if source.is_live else digest(*fingerprint),
        "the camera": digest(*seen),
        "the known map": digest(*known) if system.maps[0].num_points else "",
        **{
            f"--{name.replace('_', '-')}": str(value)
            for name, value in _flat({**own, **asdict(system.config)})
        },
    }


def start_or_continue(
    folder: Path, key: Key, system: Slam, source: FrameSource, job: JobOptions
) -> Continued:
    """Continue the stopped live run of a folder if `job.resume` is set; otherwise start a new run.

    Args:
        folder: the checkpoint folder.
        key: key of this run.
        system: SLAM before its first frame; continuing gives it the saved map.
        source: source of all frames.
        job: options.

    Raises:
        ConfigError: the stopped run had another source or other options, or would be lost.
        FileFormatError: the saved files are damaged.
        WorkspaceError: the folder was not created by epipole, or cannot be written.
    """
    can_repeat = not (source.is_live or job.realtime)
    records = _saved(folder, key, system, job) if not can_repeat else []
    notes = (STARTED_AGAIN,) if can_repeat and job.resume and (folder / KEY).is_file() else ()
    if not records:
        remove_checkpoint(folder)
        with reporting(folder):
            folder.mkdir(exist_ok=True)
        mark_checkpoint(folder, key, is_written=False)
    autosave = Autosave(folder, source.body_from_camera, can_repeat=can_repeat)
    autosave.start(system, records)
    if not records:
        return Continued(autosave, [], source, job, 0, 0, notes)
    last = records[-1].number
    num_dropped = max(0, (last - job.start) // job.stride + 1 - len(records))
    left = source if source.is_live else _after(source, last)
    job = replace(job, start=job.stride - 1)
    if job.max_frames is not None:
        num_left = job.max_frames - len(records)
        left = left if num_left > 0 else replace(left, num_frames=0, frames=_no_frames)
        job = replace(job, max_frames=max(num_left, 1))
    return Continued(autosave, records, left, job, last + 1 if source.is_live else 0, num_dropped)


@contextmanager
def completing(folder: Path, key: Key, *, is_complete: bool) -> Iterator[None]:
    """Results are written inside this block; afterwards a complete run cannot be continued.

    Raises:
        WorkspaceError: the folder is not writable.
    """
    no_model = None
    try:
        yield
    except NoModelError as error:  # nothing to write
        no_model = error
    if is_complete:
        remove_checkpoint(folder)
    else:
        mark_checkpoint(folder, key, is_written=True)
    if no_model is not None:
        raise no_model


def mark_checkpoint(folder: Path, key: Key, *, is_written: bool) -> None:
    """Write the key of the run, and whether the results of all its frames have been written.

    Raises:
        WorkspaceError: the folder is not writable.
    """
    with atomic_write(folder / KEY) as aside:
        aside.write_text(json_text({"key": key, "is_written": is_written}, indent=1), encoding="utf-8")


def _saved(folder: Path, key: Key, system: Slam, job: JobOptions) -> list[FrameRecord]:
    """Restore a stopped live run in `system` and return its frames; empty if there is no run to continue.

    Raises:
        ConfigError: the folder contains another run, which must not be lost.
        FileFormatError: the saved files are damaged.
    """
    if not (folder / KEY).is_file() or not (folder / ANSWERS).is_file():
        return []
    advice = f"remove {folder} to start again"
    try:
        content = read_json(folder / KEY)
        before, is_written = dict(content["key"]), bool(content["is_written"])
    except (ValueError, KeyError, TypeError, OSError) as error:
        raise FileFormatError(folder / KEY, f"is damaged ({error}); {advice}") from error
    if not job.resume:
        if is_written:
            return []
        raise ConfigError(
            f"{folder} contains the trajectory of a stopped run whose frames cannot be read again: continue it with --resume,"
            " or choose another output folder"
        )
    other = [name for name in {**before, **key} if before.get(name) != key.get(name)]
    if other:
        differences = "; ".join(_difference(name, before.get(name), key.get(name)) for name in other)
        raise ConfigError(f"the run in {folder} cannot be continued: {differences}; {advice}")
    try:
        records = read_answers(folder / ANSWERS)
        _restore(folder, system, records)
    except (FileFormatError, ConfigError) as error:
        raise FileFormatError(folder, f"{error}; {advice}") from error
    return records


def _restore(folder: Path, system: Slam, records: Sequence[FrameRecord]) -> None:
    """Continue in the saved map, or in a new one if none was saved yet.

    Raises:
        FileFormatError: the map is damaged.
        ConfigError: the map was made with another camera.
    """
    tracked = [record.answer for record in records if record.answer is not None]
    # A process killed between writing a map and removing the previous one leaves two.
    stems = [path.stem.partition("-")[2] for path in folder.glob(SAVED_MAP.format("*"))]
    numbers = [int(stem) for stem in stems if stem.isdecimal() and len(stem) < 16]
    if numbers:
        model = read_slam_map(folder / SAVED_MAP.format(max(numbers)), system.camera).model
        model.number = max(numbers)
        system.continue_in(model, tracked)
        return
    system.continue_in(system.maps[0], tracked)


def _difference(name: str, then: str | None, now: str | None) -> str:
    if not name.startswith("--") and name != "the version of epipole":
        return f"{name} have changed" if name.endswith("files") else f"{name} has changed"
    return f"{name} was {then or 'not given'} and is now {now or 'not given'}"


def _after(source: FrameSource, last: int) -> FrameSource:
    """The frames after the given one."""
    frames = source.frames()
    for queued in frames:
        if queued.number == last:
            break
    return replace(source, num_frames=max(source.num_frames - last - 1, 0), frames=lambda: frames)


def _no_frames() -> Generator[QueuedFrame, None, None]:
    yield from ()


def _flat(options: dict[str, Any], before: str = "") -> list[tuple[str, Any]]:
    """Nested options as dotted names and values."""
    out: list[tuple[str, Any]] = []
    for name, value in options.items():
        own = f"{before}{name}"
        out += _flat(value, f"{own}.") if isinstance(value, dict) else [(own, value)]
    return out
