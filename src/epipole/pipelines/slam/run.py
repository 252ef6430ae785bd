"""The `slam` job: from frames to an output folder with trajectory, map and report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from time import perf_counter
from typing import Any, Unpack

from epipole._checks import as_path, checked
from epipole._jit import compile_seconds
from epipole.cameras import Camera
from epipole.cameras.image_fit import ImageShape
from epipole.config import ANCHOR_FILES, AnchorOptions, options_of
from epipole.errors import ConfigError, DegenerateGeometryError, EpipoleError
from epipole.io.bags.recording import is_bag
from epipole.io.bags.writing import require_writing
from epipole.io.images.photographs import read_header
from epipole.io.images.video import is_video
from epipole.io.sequences.sequence import read_sequence
from epipole.pipelines.slam.config import CameraOptions, JobOptions, SlamConfig
from epipole.pipelines.slam.map.local_mapping import LAST_STEPS
from epipole.pipelines.slam.options import SlamKeywords
from epipole.pipelines.slam.output import autosave
from epipole.pipelines.slam.output.known_maps import KnownMaps, read_known_maps
from epipole.pipelines.slam.output.live import LiveView, open_live
from epipole.pipelines.slam.output.map_file import KnownMap, require_map
from epipole.pipelines.slam.output.meshing import check_mesh, publish_mesh
from epipole.pipelines.slam.output.record import FrameRecord
from epipole.pipelines.slam.output.results import (
    LOCALIZED,
    LOCALIZED_WORDS,
    RunInputs,
    SlamResult,
    keep_better,
    keyframe_names,
    write_results,
)
from epipole.pipelines.slam.output.resuming import Continued, completing, key_of, start_or_continue
from epipole.pipelines.slam.output.ros_record import Recording, open_recording
from epipole.pipelines.slam.output.scale import anchor_map, check_known_map, check_one_camera, level_map
from epipole.pipelines.slam.output.truth import true_path_at
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.sources.folder import FrameSource, open_sequence
from epipole.pipelines.slam.sources.frame_stream import FrameStream
from epipole.pipelines.slam.sources.intrinsics import FoundCamera, find_camera
from epipole.pipelines.slam.sources.live_cameras import camera_indices, open_cameras
from epipole.pipelines.slam.sources.rig_bag import open_rig_bag
from epipole.pipelines.slam.sources.rig_folder import open_rig_folder
from epipole.pipelines.slam.sources.streams import open_bag_frames, open_video_frames
from epipole.runs import (
    Job,
    Progress,
    ProgressCallback,
    Run,
    graceful_interrupt,
    ignore_progress,
    open_run,
    refuse_existing,
)
from epipole.runs.earlier import refuse_poorer
from epipole.runs.folder import check_output_path
from epipole.scale import Anchoring, check_anchor_files, mounted_imu

FILES = ("truth", "masks", "record", *ANCHOR_FILES)
"""Options that name a file."""
_SENSORS = (
    (
        ("auto", "mono", "stereo"),
        "a video has no depth: sensor must be auto, mono, or stereo for two images side by side",
    ),
    (
        ("auto", "mono", "stereo"),
        "a live camera has no depth: sensor must be auto, mono, or stereo for two images side by side",
    ),
    (("auto", "stereo"), "two live cameras are a stereo pair: sensor must be auto or stereo"),
)
"""Sensors of a video, of one live camera and of two, and the message for others."""


@checked
def slam(
    source: str | Path,
    out: str | Path,
    config: SlamConfig | None = None,
    progress: ProgressCallback = ignore_progress,
    **options: Unpack[SlamKeywords],
) -> SlamResult:
    """Track a camera, and write its trajectory and the map.

    Ctrl-C stops tracking; the frames tracked so far are optimized and written (`interrupted` in the summary).

    Args:
        source: a 7-Scenes, TUM RGB-D, EuRoC or KITTI odometry folder, a folder of images, a video, a ROS bag
            (.bag, .db3, .mcap or the folder of a ROS 2 bag), or the number of a local camera, or of two ("0,1").
        out: output folder, created if missing.
        config: options; None for the defaults.
        progress: called after each frame.
        **options: single options by name, such as `sensor="mono"`, which override `config`.

    Raises:
        NoModelError: no frame was localized; the message says why.
        ConfigError: options do not fit the source.
        FileFormatError: the source or a given file cannot be read.
        WorkspaceError: the output folder cannot be used, or contains an earlier result with more frames.
    """
    wanted = _config_of(config, options)
    source, out = as_path(str(source)), as_path(out)
    _check_source(source, wanted)
    _check_target(source, out, wanted)
    truth = None if wanted.truth is None else true_path_at(wanted.truth)
    found = find_camera(source, wanted, wanted, progress)
    frames = _open(source, wanted, wanted, found)
    maps = read_known_maps(wanted.map, frames.camera, wanted, progress)
    known = None if maps is None else maps.first
    system = _system(frames, wanted, maps)
    _check_camera(frames, wanted, known)
    task = _job(source, wanted, progress)
    shown = open_live(system, FrameStream(frames, wanted).num_expected, wanted, out.name)
    recorded = open_recording(wanted.record, frames.camera, frames.body_from_camera)
    with recorded as record, open_run(task, out) as run, shown as live, graceful_interrupt() as is_stopped:
        key = key_of(run.folder.source.fingerprint, frames, system, wanted)
        stands = start_or_continue(run.root / autosave.FOLDER, key, system, frames, wanted)
        run.warnings += [*_notes(found, system, wanted.anchors), *(maps.notes if maps else ()), *stands.notes]
        _warm_up(system, frames, wanted, run)
        stream = FrameStream(stands.source, stands.job, is_stopped, num_dropped=stands.num_dropped)
        with run.stage("track"), closing(stands.autosave):
            records = _track(stream, system, run.job.progress, (live, record), stands, known)
        with run.stage("adjust"):
            _finish(stream, system, run, is_stopped)
            run.warnings += _left_out(system, maps, wanted)
            record.finish(system)
            run.warnings += record.warnings
            anchoring = _anchored(system, wanted.anchors, records, known, run)
            leveled, notes = level_map(system, anchoring)
            run.warnings += notes
        with completing(run.root / autosave.FOLDER, key, is_complete=not stream.is_interrupted):
            keep_better(system, run, can_repeat=not (frames.is_live or wanted.realtime))
            facts = publish_mesh(frames, system, run, is_wanted=wanted.mesh)
            given = RunInputs(truth, known, anchoring, found, leveled, facts)
            return write_results(stream, system, records, given, wanted, run)


def _job(source: Path, wanted: SlamConfig, progress: ProgressCallback) -> Job:
    settings = {name: value for name, value in asdict(wanted).items() if name != "resume"}
    return Job(kind="slam", inputs=(_input(source),), settings=settings, progress=progress, has_log=True)


def _system(frames: FrameSource, job: SlamConfig, known: KnownMaps | None) -> Slam:
    """SLAM with the options; by default a thread adjusts the map if frames do not wait, and the shutter is global."""
    mapping = job.mapping
    if mapping == "auto":
        is_timed = frames.is_live or job.realtime
        mapping = "thread" if is_timed and not frames.camera.shutter.is_rolling else "inline"
    models, imu = None if known is None else known.models, mounted_imu(job.anchors)
    return Slam(frames.camera, job, models, is_map_fixed=job.localize, imu=imu, mapping=mapping)


def _warm_up(system: Slam, frames: FrameSource, job: SlamConfig, run: Run) -> None:
    """Compile before the first frame if frames do not wait."""
    if frames.is_live or job.realtime:
        with run.stage("compile"):
            run.report("compile", 0, 1)
            system.warm_up()
            run.report("compile", 1, 1)


def _check_camera(frames: FrameSource, job: SlamConfig, known: KnownMap | None) -> None:
    """Check that the options fit the camera.

    Raises:
        ConfigError: one does not.
    """
    check_mesh(frames, job)
    check_one_camera(job.anchors, measures_depth=frames.camera.is_metric)
    if not frames.camera.is_metric:
        check_known_map(job.anchors, known, is_map_fixed=job.localize)


def _notes(found: FoundCamera | None, system: Slam, given: AnchorOptions) -> list[str]:
    """Notes on the estimated camera and on the IMU log."""
    notes = [] if found is None else list(found.notes())
    if system.imu is not None:
        notes += system.imu.log.notes
    elif given.imu is not None and system.camera.is_metric:
        notes.append("the IMU is ignored in a known map, whose clock differs")
    return notes


def _check_target(source: Path, out: Path, job: JobOptions) -> None:
    """Check the output folder before any work.

    Raises:
        WorkspaceError: the folder was not created by epipole, its result has more frames than `max_frames`, or the recording exists.
        ConfigError: the name of the recording does not end with .mcap.
        MissingDependencyError: recording needs the package rosbags.
    """
    check_output_path(out, "slam", (_input(source),))
    if job.record is not None:
        require_writing(job.record)
        inputs = (_input(source), *([] if job.truth is None else [job.truth]), *job.map)
        refuse_existing([job.record], "slam", inputs)
    if job.max_frames is not None:
        refuse_poorer(out, LOCALIZED, job.max_frames, LOCALIZED_WORDS)


def _finish(stream: FrameStream, system: Slam, run: Run, is_stopped: Callable[[], bool]) -> None:
    """Final optimization; Ctrl-C stops it, unless it was already used to stop tracking."""
    total, was_stopped = LAST_STEPS * len(system.maps), stream.is_interrupted

    def goes_on(done: int, of: int) -> bool:
        run.report("adjust", done, of)
        stream.is_interrupted |= done < of and is_stopped()
        return was_stopped or not stream.is_interrupted

    run.report("adjust", 0, total)
    while True:
        try:
            system.wait_for_mapping()
            break
        except EpipoleError as error:  # each time, fewer keyframes wait
            run.warnings.append(f"the map was not adjusted around some of its keyframes: {error}")
    system.finish(goes_on)
    run.report("adjust", total, total)


def _left_out(system: Slam, known: KnownMaps | None, job: JobOptions) -> list[str]:
    """Remove maps without frames of this run, and say which known maps are still separate from the first one."""
    notes = []
    paths = [system.trajectory(n) for n in range(len(system.maps))]
    parts = [frozenset(keyframe.number for keyframe in model.keyframes) for model in system.maps]
    for path, numbers in {} if known is None else known.numbers.items():
        if numbers & parts[0]:
            continue
        if any(numbers & part and len(found) for part, found in zip(parts[1:], paths[1:])):
            notes.append(
                f"the map {path} is separate from the first map: its frames are in trajectory_submap_N.txt"
            )
        else:
            notes.append(f"no frame of this run connected the map {path} to the first map")
        notes[-1] += "" if job.localize else ", so it is not part of the new map"
    system.maps[1:] = [model for model, found in zip(system.maps[1:], paths[1:]) if len(found)]
    return notes


def _anchored(
    system: Slam, options: AnchorOptions, records: list[FrameRecord], known: KnownMap | None, run: Run
) -> Anchoring | None:
    """Make the map metric with the given measurements; None, with a warning, if they do not determine the scale."""
    if options.is_empty or system.camera.is_metric or not len(system.trajectory()):
        return None
    frames = {r.answer.timestamp_s: r.name for r in records if r.answer is not None}
    try:
        found = anchor_map(system, options, keyframe_names(system, records, known), frames)
    except DegenerateGeometryError as error:
        run.warnings.append(f"the trajectory remains up to scale: {error}")
        return None
    run.warnings += [words for words in found.scale.warnings() if words not in run.warnings]
    return found


def _config_of(config: SlamConfig | None, options: Mapping[str, Any]) -> SlamConfig:
    """Override `config` with options given by name, in which files may be strings."""
    named = {
        name: as_path(value) if name in FILES and value is not None else value
        for name, value in options.items()
    }
    if "map" in named:
        maps = named["map"]
        maps = () if maps is None else (maps,) if isinstance(maps, str | Path) else maps
        named["map"] = tuple(as_path(path) for path in maps)
    return options_of(SlamConfig, config, named, ["config", "progress"])


def _check_source(source: Path, job: SlamConfig) -> None:
    """Check that the options fit the source.

    Raises:
        ConfigError: an option does not fit.
        FileFormatError: the known map is not a map.
    """
    for path in job.map:
        require_map(path)
    check_anchor_files(job.anchors)
    if job.sensor == "rig" and source.exists() and not (source.is_dir() or is_bag(source)):
        raise ConfigError("sensor rig is for folders of images (cam0, cam1, ...) and ROS bags")
    if job.topics and not is_bag(source):
        raise ConfigError("topics is for ROS bags (.bag, .db3, .mcap or the folder of a ROS 2 bag)")
    if job.masks is not None and (is_bag(source) or not source.is_dir()):
        raise ConfigError("masks is for folders of images")
    cameras = camera_indices(source)
    if not is_bag(source) and (cameras or is_video(source)):
        if job.fps is not None:
            raise ConfigError("fps is for folders of images without timestamps: a video has its own")
        if cameras and job.anchors.imu is not None:
            raise ConfigError(
                "imu is a file of finished measurements, which a live camera does not have: Slam.add_imu takes them in Python"
            )
        sensors, refusal = _SENSORS[len(cameras)]
        if job.sensor not in sensors:
            raise ConfigError(refusal)
        if job.depth_scale is not None:
            raise ConfigError("depth_scale is for depth images, which videos and cameras do not have")


def _open(source: Path, job: JobOptions, given: CameraOptions, found: FoundCamera | None) -> FrameSource:
    frames = _open_without_readout(source, job, given, found)
    if given.readout_s:
        frames = replace(frames, camera=replace(frames.camera, readout_s=given.readout_s))
    return frames


def _open_without_readout(
    source: Path, job: JobOptions, given: CameraOptions, found: FoundCamera | None
) -> FrameSource:
    if is_bag(source):
        return (open_rig_bag if job.sensor == "rig" else open_bag_frames)(source, job, given)
    cameras = camera_indices(source)
    if cameras:
        is_pair = len(cameras) == 2 or job.sensor == "stereo"
        return open_cameras(cameras, "stereo" if is_pair else "mono", given)
    if is_video(source):
        camera, is_pair = None if found is None else found.camera, job.sensor == "stereo"
        frames = open_video_frames(source, given, camera, is_pair=is_pair)
    else:
        frames = _open_folder(source, job, given, None if found is None else found.camera)
    return frames if found is None else replace(frames, about={**frames.about, "camera_source": found.source})


def _open_folder(folder: Path, job: JobOptions, given: CameraOptions, found: Camera | None) -> FrameSource:
    if job.sensor == "rig":
        return open_rig_folder(folder, job, given)
    sequence = read_sequence(folder, job.fps, given.depth_scale)
    header = read_header(sequence.frames[0].image)
    known = given.fitted_camera(ImageShape(header.width, header.height, header.orientation))
    camera, notes = (found, []) if found or known is None else known
    opened = open_sequence(sequence, job.sensor, camera, job.masks)
    if given.depth_scale is not None and opened.camera.depth is None:
        raise ConfigError("depth_scale is given, but depth images are not used: check sensor")
    return replace(opened, notes=lambda: [*notes, *opened.notes()])


def _input(source: Path) -> Path:
    """Path of the source, for the output folder's record of its inputs."""
    cameras = camera_indices(source)
    return Path(",".join(f"/dev/video{index}" for index in cameras)) if cameras else source


def _track(
    stream: FrameStream,
    system: Slam,
    progress: ProgressCallback,
    watching: tuple[LiveView, Recording],
    stands: Continued,
    known: KnownMap | None,
) -> list[FrameRecord]:
    """Track every frame; frames that cannot be read or do not fit are left out and reported."""
    (live, recording), records, before = watching, stands.records, len(stands.records)
    for queued in stream:
        answer, problem, start, compiling = None, "", perf_counter(), compile_seconds()
        number = stands.first_number + queued.number
        try:
            frame = queued.read()
            start = perf_counter()
            answer = system.track(frame)
        except EpipoleError as error:
            problem = f"frame {number} is left out: {error}"
        # The mapping thread compiles, too, and not only in this frame's time.
        seconds = max(perf_counter() - start - (compile_seconds() - compiling), 0.0)
        records.append(FrameRecord(number, queued.name, seconds, answer, problem))
        stands.autosave.add(system, records, lambda: keyframe_names(system, records, known))
        if answer is not None:
            live.show(system, frame, answer)
            recording.add(system, frame, answer)
        progress(Progress("track", len(records), max(before + stream.num_expected, len(records))))
    stands.autosave.save_map(system, lambda: keyframe_names(system, records, known))
    live.show_map(system, "Optimizing the map")
    return records
