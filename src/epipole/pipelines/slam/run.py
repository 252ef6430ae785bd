"""The job: frames to a trajectory, a map and a summary in one folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from epipole._checks import as_path
from epipole.config import options_of
from epipole.errors import ConfigError, EpipoleError, NoModelError
from epipole.geometry import Rigid3
from epipole.io.bags import is_bag
from epipole.io.colmap import write_colmap_model
from epipole.io.photographs import read_header
from epipole.io.ply import write_scene_ply
from epipole.io.sequences import read_sequence
from epipole.io.trajectories import write_trajectory
from epipole.io.video import is_video
from epipole.pipelines.slam.config import CameraOptions, JobOptions, SlamConfig
from epipole.pipelines.slam.export import reconstruction_of
from epipole.pipelines.slam.feeding import Feed, heeded_interrupts
from epipole.pipelines.slam.formats import missing_rows, write_in_format
from epipole.pipelines.slam.frames import TrackedFrame, TrackingState
from epipole.pipelines.slam.moving_sources import (
    camera_index,
    open_bag_frames,
    open_camera,
    open_video_frames,
)
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.source import FrameSource, open_sequence
from epipole.runs import Job, Progress, ProgressCallback, ignore_progress, open_run
from epipole.scene import Trajectory

TRAJECTORY, CAUSAL, WITH_COVARIANCE = "trajectory.txt", "trajectory_causal.txt", "trajectory_covariance.txt"


@dataclass(frozen=True, slots=True, eq=False)
class SlamResult:
    """What `slam` returns; everything is also in the output folder."""

    out: Path
    trajectory: Trajectory
    """Every frame that has a place, by the whole map."""
    causal: Trajectory
    """What was known when each frame came."""
    summary: dict[str, Any]
    """As in `summary.json`."""
    warnings: tuple[str, ...]

    def __repr__(self) -> str:
        return f"SlamResult({self.trajectory!r} in {self.out})"


def slam(
    source: str | Path,
    out: str | Path,
    config: SlamConfig | None = None,
    job: JobOptions | None = None,
    camera: CameraOptions | None = None,
    progress: ProgressCallback = ignore_progress,
    **options: Any,
) -> SlamResult:
    """Follow a camera through frames, and write its path and map.

    Ctrl-C ends the frames: what was followed by then is adjusted and written (`interrupted` in the summary).

    Args:
        source: a 7-Scenes, TUM RGB-D, EuRoC or KITTI odometry folder, a folder of pictures, a video, a recording of ROS
            (.bag, .db3, .mcap or the folder of a ROS 2 bag), or the number of a camera at this computer.
        out: output folder, made if missing.
        config: options; None for the defaults.
        job: what is taken of the source (sensor, topics, max_frames), how (realtime), and what is written.
        camera: intrinsics, for sources that do not tell them.
        progress: called after each frame.
        **options: single options of `job` or the config by name, which override them.

    Raises:
        NoModelError: no frame got a place; the message says why.
        ConfigError: options do not fit the frames.
        FileFormatError: the source cannot be read.
        WorkspaceError: the output folder cannot be used.
    """
    own = {field.name for field in fields(JobOptions)} & options.keys()
    wanted = options_of(JobOptions, job, {name: options.pop(name) for name in own})
    config, source, out = options_of(SlamConfig, config, options), as_path(str(source)), as_path(out)
    given = options_of(CameraOptions, camera)
    frames = _open(source, wanted, given)
    settings = {"job": asdict(wanted), "camera": asdict(given), "config": asdict(config)}
    task = Job(kind="slam", inputs=(_input(source),), settings=settings, progress=progress)
    with open_run(task, out) as run, heeded_interrupts() as is_stopped:
        feed = Feed(frames, wanted, is_stopped)
        with run.stage("track"):
            system, tracked, names, problems, times = _track(feed, config, progress)
        with run.stage("adjust"):
            run.report("adjust", 0, 1)
            system.finish()
            run.report("adjust", 1, 1)
        final, causal = system.trajectory(), _causal(tracked)
        if not len(final):
            raise NoModelError(f"no frame got a place: {_last_reason(tracked, problems)}")
        with run.stage("write"), run.folder.publish("slam") as aside:
            _write(system, frames, names, (final, causal), aside)
            in_format = tuple(_of_body(path, frames) for path in (final, causal))
            write_in_format(in_format, (TRAJECTORY, CAUSAL), wanted.trajectory_format, aside)
        num_frames = len(times) + feed.num_dropped
        run.warnings += [*problems, *missing_rows(final, num_frames, wanted.trajectory_format)]
        summary = {**_summary(frames, system, tracked, times, run.warnings), **feed.summary()}
        run.finish({**summary, "timings_s": run.timings_s})
    return SlamResult(out, final, causal, summary, tuple(run.warnings))


def _open(source: Path, job: JobOptions, given: CameraOptions) -> FrameSource:
    if job.topics and not is_bag(source):
        raise ConfigError("topics are of recordings of ROS (.bag, .db3, .mcap or the folder of a ROS 2 bag)")
    if is_bag(source):
        return open_bag_frames(source, job, given)
    index = camera_index(source)
    if index is not None or is_video(source):
        if job.sensor not in ("auto", "mono"):
            raise ConfigError("a video is of one camera")
        return open_video_frames(source, given) if index is None else open_camera(index, given)
    sequence = read_sequence(source)
    header = read_header(sequence.frames[0].picture)
    return open_sequence(sequence, job.sensor, given.camera((header.width, header.height)))


def _input(source: Path) -> Path:
    """What the results are of."""
    index = camera_index(source)
    return source if index is None else Path(f"/dev/video{index}")


def _track(
    feed: Feed, config: SlamConfig, progress: ProgressCallback
) -> tuple[Slam, list[TrackedFrame], list[str], list[str], list[float]]:
    """Every frame in turn; one that cannot be read, or does not fit, is left out and named.

    Returns:
        The SLAM, its answers, the names of the frames that it took, what is wrong with the others, and seconds of each.
    """
    system = Slam(feed.source.camera, config)
    tracked: list[TrackedFrame] = []
    names: list[str] = []
    problems: list[str] = []
    times: list[float] = []
    for queued in feed:
        begin = perf_counter()
        try:
            frame = queued.read()
            begin = perf_counter()
            tracked.append(system.track(frame))
            names.append(queued.name)
        except EpipoleError as error:
            problems.append(f"frame {queued.number} is left out: {error}")
        times.append(perf_counter() - begin)
        progress(Progress("track", len(times), max(feed.num_expected, len(times))))
    return system, tracked, names, [*problems, *feed.notes()], times


def _causal(tracked: Sequence[TrackedFrame]) -> Trajectory:
    rows = [(t, t.world_from_body, t.covariance) for t in tracked]
    placed = [(t.timestamp_s, place, covariance) for t, place, covariance in rows if place is not None]
    return Trajectory(
        np.array([time for time, _, _ in placed], np.float64).reshape(-1),
        Rigid3(
            np.array([place.rotation for _, place, _ in placed]).reshape(-1, 3, 3),
            np.array([place.translation for _, place, _ in placed]).reshape(-1, 3),
        ),
        np.array([np.zeros((6, 6)) if c is None else c for _, _, c in placed]).reshape(-1, 6, 6),
    )


def _of_body(trajectory: Trajectory, source: FrameSource) -> Trajectory:
    """The path of the camera that took the pictures, not of its rectified picture."""
    turned = source.body_from_camera
    places = trajectory.world_from_body @ turned.inverse()
    adjoint = turned.adjoint()
    covariance = trajectory.covariance
    if covariance is not None:
        covariance = adjoint @ covariance @ adjoint.T
    return Trajectory(trajectory.timestamp_s, places, covariance)


def _write(
    system: Slam,
    source: FrameSource,
    names: Sequence[str],
    paths: tuple[Trajectory, Trajectory],
    folder: Path,
) -> None:
    final, causal = (_of_body(path, source) for path in paths)
    write_trajectory(final, folder / TRAJECTORY)
    write_trajectory(causal, folder / CAUSAL)
    write_trajectory(final, folder / WITH_COVARIANCE, with_covariance=True)
    model = reconstruction_of(system.map, source.camera.camera, names)
    if len(model.images) >= 2:
        write_colmap_model(model, folder / "sparse" / "0")
        write_scene_ply(folder / "points.ply", model)


def _summary(
    source: FrameSource,
    slam: Slam,
    tracked: Sequence[TrackedFrame],
    times: Sequence[float],
    warnings: list[str],
) -> dict[str, Any]:
    states = [t.state for t in tracked]
    ms = 1e3 * np.array(times) if len(times) else np.zeros(1)
    placed = len(slam.trajectory())
    tells = source.camera.tells_depth
    return {
        "num_frames": len(times),
        "num_placed": placed,
        "num_placed_causal": sum(t.world_from_body is not None for t in tracked),
        "states": {state.value: states.count(state) for state in TrackingState},
        "num_keyframes": len(slam.map.keyframes),
        "num_points": int(np.isfinite(slam.map.xyz[:, 0]).sum()),
        "scale": _scale_words(source) if tells else "up to scale: one camera cannot tell lengths",
        "is_metric": tells,
        "ms_per_frame": {
            "median": float(np.median(ms)),
            "p95": float(np.percentile(ms, 95)),
            "max": float(ms.max()),
        },
        "reasons": _reasons(tracked),
        "warnings": warnings,
    }


def _scale_words(source: FrameSource) -> str:
    if source.camera.depth is not None:
        return "metres, from the depth sensor"
    return f"metres, from the baseline of {source.camera.baseline:.4g} m"


def _reasons(tracked: Sequence[TrackedFrame]) -> dict[str, int]:
    """Why frames have no place, and how many."""
    out: dict[str, int] = {}
    for frame in tracked:
        if frame.world_from_body is None:
            words = "".join("#" if c.isdigit() else c for c in frame.reason)
            out[words] = out.get(words, 0) + 1
    return out


def _last_reason(tracked: Sequence[TrackedFrame], problems: Sequence[str]) -> str:
    if tracked:
        return tracked[-1].reason
    return problems[0] if problems else "there is no frame"
