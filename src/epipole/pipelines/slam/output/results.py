"""Results of a SLAM run: trajectories, map, table of frames, summary and report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from epipole.errors import NoModelError
from epipole.geometry import Rigid3, Similarity3
from epipole.image.pixels_without_ray import no_ray_warning, pixels_without_ray
from epipole.io.colmap.model import write_colmap_model
from epipole.io.meshes.ply import write_scene_ply
from epipole.io.trajectories.files import write_trajectory
from epipole.io.trajectories.frame_tables import FRAME_TABLE
from epipole.io.trajectories.true_trajectories import Truth
from epipole.pipelines.slam.config import JobOptions
from epipole.pipelines.slam.frames import TrackedFrame, TrackingState
from epipole.pipelines.slam.loops.recognition import MIN_SAMPLE
from epipole.pipelines.slam.map.covariance import CalibrationSigma
from epipole.pipelines.slam.map.mounting_check import check_mounting
from epipole.pipelines.slam.output.camera_check import camera_warnings, check_camera
from epipole.pipelines.slam.output.export import reconstruction_of
from epipole.pipelines.slam.output.formats import missing_rows, write_in_format
from epipole.pipelines.slam.output.map_file import MAP_FILE, KnownMap, distinct_names, write_slam_map
from epipole.pipelines.slam.output.page import SlamPage, render_page
from epipole.pipelines.slam.output.record import FrameRecord, without_numbers, write_records
from epipole.pipelines.slam.output.scale import moved_path
from epipole.pipelines.slam.output.truth import truth_at_frames, truth_summary
from epipole.pipelines.slam.output.warnings import moving_things, poor_images, warnings
from epipole.pipelines.slam.shutter.check import find_readout, with_readout
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.sources.folder import FrameSource
from epipole.pipelines.slam.sources.frame_stream import FrameStream
from epipole.pipelines.slam.sources.intrinsics import FoundCamera
from epipole.runs import Run
from epipole.runs.earlier import note_on_poorer, refuse_poorer
from epipole.scale import Anchoring
from epipole.scene import Reconstruction, Trajectory
from epipole.scene.notebook import table_html

TRAJECTORY, CAUSAL = "trajectory.txt", "trajectory_causal.txt"
WITH_COVARIANCE, CAUSAL_COVARIANCE = "trajectory_covariance.txt", "trajectory_causal_covariance.txt"
CAMERA = "camera.json"
LOCALIZED = "num_localized"
"""Key of the number of localized frames in `summary.json`."""
LOCALIZED_WORDS = "localized frames"
IN_OTHER_MAP = "tracked in a separate map that is not connected to the main one"
WARM = 2
"""After this many keyframes all code is loaded and compiled; 95th percentile and maximum of the times start there."""


@dataclass(frozen=True, slots=True, eq=False)
class SlamResult:
    """Result of `slam`; everything is also in the output folder."""

    out: Path
    trajectory: Trajectory
    """Poses of all localized frames, estimated with the final map."""
    causal: Trajectory
    """Poses as estimated when each frame arrived."""
    summary: dict[str, Any]
    """Content of `summary.json`."""
    warnings: tuple[str, ...]

    def __repr__(self) -> str:
        return f"SlamResult({self.trajectory!r} in {self.out})"

    def _repr_html_(self) -> str:
        rows = {"frames": f"{self.summary['num_localized']} of {self.summary['num_frames']} localized"}
        rows |= {"length": f"{self.trajectory.path_length():.4g}", "scale": self.summary["scale"]}
        return table_html("SlamResult", rows | {"warnings": len(self.warnings), "folder": self.out})


class RunInputs(NamedTuple):
    """Inputs of a run besides the frames."""

    truth: Truth | None
    """True trajectory to compare with."""
    map: KnownMap | None
    """Map that the run continued in."""
    anchoring: Anchoring | None
    """How the map became metric."""
    camera: FoundCamera | None = None
    """The camera, if it was estimated from the images."""
    leveled: Similarity3 | None = None
    """Rotation of the map to gravity's direction, after it became metric."""
    mesh: dict[str, Any] | None = None
    """Figures of the mesh."""


def write_results(
    stream: FrameStream,
    system: Slam,
    records: list[FrameRecord],
    given: RunInputs,
    job: JobOptions,
    run: Run,
) -> SlamResult:
    """Write the results of a run.

    Args:
        stream: source of the frames.
        system: SLAM after the last frame.
        records: one record per frame.
        given: inputs besides the frames.
        job: options of the output.
        run: the output folder.

    Raises:
        NoModelError: no frame was localized.
    """
    source, truth = stream.source, given.truth
    tracked = [record.answer for record in records if record.answer is not None]
    problems = [record.problem for record in records if record.problem] + stream.notes()
    if not len(system.trajectory()):
        raise NoModelError(f"no frame was localized: {_last_reason(tracked, problems)}")
    came, anchoring = _causal(system, tracked), given.anchoring
    for moved in (None if anchoring is None else anchoring.world_from_model, given.leveled):
        came = came if moved is None else moved_path(came, moved)
    final, causal = (_of_body(path, source) for path in (system.trajectory(), came))
    names = keyframe_names(system, records, given.map)
    model = reconstruction_of(system.maps[0], source.camera.camera_or_rig, names, source.rig_names)
    num_frames = len(records) + stream.num_dropped
    run.warnings += [*problems, *missing_rows(final, num_frames, job.trajectory_format)]
    checked = _checked(system, tracked, final, run)
    run.warnings += system.start_warnings
    facts = _summary(system, records, model, run.warnings)
    summary, known = {**facts, **stream.summary(), **checked}, None
    if given.camera is not None:
        summary["camera_found"] = given.camera.summary()
    meters, noted = _meters(given, source, is_map_fixed=job.localize)
    summary |= noted | ({} if given.mesh is None else {"mesh": given.mesh})
    if truth is not None:
        known = truth_at_frames(truth, records)
        summary["truth"], odd = truth_summary(truth, known, (final, causal), len(records))
        run.warnings += odd
    with run.stage("write"), run.folder.publish("slam") as aside:
        submaps = [_of_body(system.trajectory(n), source) for n in range(1, len(system.maps))]
        _write(model, (final, causal), submaps, records, aside)
        write_slam_map(aside / MAP_FILE, system.maps[0], names, source.camera, meters)
        if given.camera is not None:
            given.camera.write(aside / CAMERA)
        write_in_format((final, causal), (TRAJECTORY, CAUSAL), job.trajectory_format, aside)
    with run.stage("report"):
        title = run.job.inputs[0].resolve().name
        paths = (final, causal, known)
        page = SlamPage(title, summary, records, model, *paths, run.job.settings, run.timings_s)
        run.folder.write_text("report.html", render_page(page))
    run.finish({**summary, "timings_s": run.timings_s})
    return SlamResult(run.root, final, causal, summary, tuple(run.warnings))


def keep_better(system: Slam, run: Run, *, can_repeat: bool) -> None:
    """Refuse to replace a result with more localized frames; if the frames cannot be read again, warn instead.

    Raises:
        WorkspaceError: an earlier result has more frames, and these can be read again.
    """
    num_localized = len(system.trajectory())
    if num_localized and can_repeat:
        refuse_poorer(run.root, LOCALIZED, num_localized, LOCALIZED_WORDS)
    else:
        run.warnings += note_on_poorer(run.root, LOCALIZED, num_localized, LOCALIZED_WORDS)


def _checked(system: Slam, tracked: Sequence[TrackedFrame], path: Trajectory, run: Run) -> dict[str, Any]:
    """Check intrinsics, images and scene: returns facts for the summary and adds warnings to the run."""
    with run.stage("check"):
        model = system.maps[0]
        mapper = system.local_mapper(model)
        # Of a rig, the mounting is checked instead of the shutter and the intrinsics.
        is_rig = system.camera.rig is not None
        is_unchecked = is_rig or system.camera.shutter.is_rolling
        shutter = None if is_unchecked else find_readout(mapper, system.trajectory())
        with with_readout(mapper, system.trajectory(), 0.0 if shutter is None else shutter.readout_s):
            camera = None if is_rig else check_camera(model, system.camera.camera)
        mounting = check_mounting(mapper) if is_rig else None
        cameras = [system.camera.camera] if system.camera.rig is None else system.camera.rig.cameras
        blind = [pixels_without_ray(one) for one in cameras]
        run.warnings += [words for one in cameras for words in no_ray_warning(one)]
        run.warnings += [] if shutter is None else [shutter.warning()]
        run.warnings += [] if is_unchecked else _keyframe_notes(system)
        run.warnings += [] if mounting is None else mounting.warnings()
        run.warnings += [*camera_warnings(camera, model.right_shift_px), *warnings(tracked, path)]
        return {
            "readout_s": system.camera.readout_s if shutter is None else shutter.readout_s,
            "camera_check": None if camera is None else asdict(camera),
            "mounting_check": None if mounting is None else asdict(mounting),
            "fraction_without_ray": float(np.mean([0.0 if one is None else one.mean() for one in blind])),
            "right_principal_point_shift_px": model.right_shift_px,
            "poor_images": poor_images(tracked),
            "moving": moving_things(tracked),
        }


def _keyframe_notes(system: Slam) -> list[str]:
    """What `keyframe_rotation` set to False does not change, or prevents."""
    if system.config.keyframe_rotation:
        return []
    if system.odometry.tracker.choice.counts_rotation:
        return ["--no-keyframe-rotation has no effect with one camera or an IMU"]
    return [
        "a rolling shutter may not be detected with --no-keyframe-rotation: the keyframes rotate too little"
    ]


def _covariance_words(system: Slam) -> str:
    """Which errors the covariances of the trajectory cover, and which they exclude."""
    if not system.camera.is_metric:
        return (
            "they cover the image noise of each frame (one pixel); they exclude errors of the map, of its scale and of the"
            " calibration"
        )
    if system.is_map_fixed:
        return "they cover image noise and exclude errors of the known map and of the calibration"
    sigma = CalibrationSigma.of(system.camera, system.config).in_words()
    return (
        f"they cover image noise and, in the final trajectory, calibration errors of {sigma} (one standard deviation each); they"
        " exclude a rolling shutter, lens distortion that the camera model lacks, depth errors that vary over the image, and wrong"
        " matches"
    )


def _median_sigma(path: Trajectory) -> float | None:
    """Median standard deviation of the positions, in the trajectory's unit; None if none is known."""
    if path.covariance is None:
        return None
    variance = np.trace(path.covariance[:, :3, :3], axis1=1, axis2=2)
    known = variance[np.isfinite(variance) & (variance > 0)]
    return float(np.sqrt(np.median(known))) if len(known) else None


def keyframe_names(system: Slam, records: Sequence[FrameRecord], known: KnownMap | None) -> list[str]:
    """Image names of the first map's keyframes: `earlier/NAME` for those of a known map whose name this run uses, too."""
    names = [record.name for record in records if record.answer]
    earlier = () if known is None else distinct_names(known.names, set(names), "earlier")
    named = {} if known is None else dict(zip(known.numbers, earlier))
    named |= {system.first_number + n: name for n, name in enumerate(names)}
    return [named[keyframe.number] for keyframe in system.maps[0].keyframes]


def _causal(system: Slam, tracked: Sequence[TrackedFrame]) -> Trajectory:
    """Poses in the main map as estimated when the frames arrived."""
    first = system.first_frame - system.first_number
    own = [t for t in tracked[first:] if t.map_number == system.maps[0].number]
    rows = [
        (t, t.submap_from_body if t.world_from_body is None else t.world_from_body, t.covariance) for t in own
    ]
    localized = [
        (t.timestamp_s, position, covariance) for t, position, covariance in rows if position is not None
    ]
    return Trajectory(
        np.array([time for time, _, _ in localized], np.float64).reshape(-1),
        Rigid3(
            np.array([position.rotation for _, position, _ in localized]).reshape(-1, 3, 3),
            np.array([position.translation for _, position, _ in localized]).reshape(-1, 3),
        ),
        np.array([np.zeros((6, 6)) if c is None else c for _, _, c in localized]).reshape(-1, 6, 6),
    )


def _of_body(trajectory: Trajectory, source: FrameSource) -> Trajectory:
    """Transform a trajectory of the rectified camera into that of the camera that took the images."""
    rotated = source.body_from_camera
    if np.array_equal(rotated.rotation, np.eye(3)) and not rotated.translation.any():
        return trajectory
    positions = trajectory.world_from_body @ rotated.inverse()
    adjoint = rotated.adjoint()
    covariance = trajectory.covariance
    if covariance is not None:
        covariance = adjoint @ covariance @ adjoint.T
    return Trajectory(trajectory.timestamp_s, positions, covariance)


def _write(
    model: Reconstruction,
    paths: tuple[Trajectory, Trajectory],
    submaps: Sequence[Trajectory],
    records: Sequence[FrameRecord],
    folder: Path,
) -> None:
    final, causal = paths
    write_trajectory(final, folder / TRAJECTORY)
    write_trajectory(causal, folder / CAUSAL)
    write_trajectory(final, folder / WITH_COVARIANCE, with_covariance=True)
    write_trajectory(causal, folder / CAUSAL_COVARIANCE, with_covariance=True)
    write_records(records, folder / FRAME_TABLE)
    for number, path in enumerate(submaps, 1):
        write_trajectory(path, folder / f"trajectory_submap_{number}.txt")
    if len(model.images) >= 2:
        write_colmap_model(model, folder / "sparse" / "0")
        write_scene_ply(folder / "points.ply", model)


def _summary(
    slam: Slam,
    records: Sequence[FrameRecord],
    model: Reconstruction,
    warnings: list[str],
) -> dict[str, Any]:
    tracked = [record.answer for record in records if record.answer is not None]
    states = [t.state for t in tracked]
    ms = 1e3 * np.array([record.seconds for record in records]) if records else np.zeros(1)
    keyframes = [n for n, record in enumerate(records) if record.answer and record.answer.is_keyframe]
    warm = ms[keyframes[WARM - 1] + 1 :] if len(keyframes) >= WARM else ms
    localized, error_px = len(slam.trajectory()), model.mean_reprojection_error_px()
    return {
        "num_frames": len(records),
        LOCALIZED: localized,
        "num_localized_causal": len(_causal(slam, tracked)),
        "states": {state.value: states.count(state) for state in TrackingState},
        "num_keyframes": len(slam.maps[0].keyframes),
        "mapping": "inline" if slam.mapping_thread is None else "thread",
        "num_keyframes_merged": 0 if slam.mapping_thread is None else slam.mapping_thread.num_merged,
        "num_points": int(np.isfinite(slam.maps[0].xyz[:, 0]).sum()),
        "mean_reprojection_error_px": error_px if np.isfinite(error_px) else None,
        "ms_per_frame": {
            "median": float(np.median(ms)),
            "p95": float(np.percentile(warm if len(warm) else ms, 95)),
            "max": float(warm.max() if len(warm) else ms.max()),
        },
        "reasons": _reasons(tracked),
        "covariances": _covariance_words(slam),
        "sigma_position_median": _median_sigma(slam.trajectory()),
        "submaps": [_submap_words(slam, n) for n in range(1, len(slam.maps))],
        "num_places_compared": len(slam.loops),
        "loops": [asdict(loop) for loop in slam.loops if loop.num_matches >= MIN_SAMPLE],
        "warnings": warnings,
    }


def _submap_words(slam: Slam, number: int) -> dict[str, Any]:
    """Summary of a submap that no loop connects to the first map."""
    path = slam.trajectory(number)
    return {
        "num_frames": len(path),
        "num_keyframes": len(slam.maps[number].keyframes),
        "from_s": float(path.timestamp_s[0]) if len(path) else None,
        "to_s": float(path.timestamp_s[-1]) if len(path) else None,
        "is_metric": slam.camera.is_metric,
    }


def _meters(given: RunInputs, source: FrameSource, *, is_map_fixed: bool) -> tuple[str, dict[str, Any]]:
    """Source of the metric scale for the map's file (empty if up to scale), and the scale entries of this run's summary."""
    known, more = given.map, {}
    if given.anchoring is not None:
        words = scale = given.anchoring.scale.in_words()
        more = {"anchor": given.anchoring.scale.summary()}
    elif source.camera.is_metric and not is_map_fixed:
        words = scale = _scale_words(source)
    elif known is not None and known.is_metric:
        whence = f" ({known.scale.removeprefix('meters, ')})" if known.scale else ""
        words, scale = known.scale or "meters", f"meters, as in the known map{whence}"
    else:
        words, scale = "", "up to scale: one camera cannot measure lengths"
    return words, {"scale": scale, "is_metric": bool(words), "world": _world_words(given), **more}


def _world_words(given: RunInputs) -> str:
    """What the axes of the world are."""
    if given.leveled is not None:
        return "z up, by the IMU; x ahead of the first camera"
    if given.anchoring is not None and given.anchoring.positions is not None:
        return "that of the measured positions"
    return "that of the known map" if given.map is not None else "the first frame's camera"


def _scale_words(source: FrameSource) -> str:
    if source.camera.depth is not None:
        return "meters, from the depth sensor"
    if source.camera.rig is not None:
        rig = source.camera.rig
        return f"meters, from the positions of the rig's {len(rig.cameras)} cameras, up to {rig.length:.4g} m apart"
    return f"meters, from the baseline of {source.camera.baseline:.4g} m"


def _reasons(tracked: Sequence[TrackedFrame]) -> dict[str, int]:
    """Count the reasons why frames had no pose when they arrived; of those that differ only in numbers, keep the last."""
    last: dict[str, str] = {}
    count: dict[str, int] = {}
    for frame in tracked:
        if frame.world_from_body is None:
            reason = frame.reason if frame.submap_from_body is None else IN_OTHER_MAP
            words = without_numbers(reason)
            last[words], count[words] = reason, count.get(words, 0) + 1
    return {last[words]: number for words, number in count.items()}


def _last_reason(tracked: Sequence[TrackedFrame], problems: Sequence[str]) -> str:
    if tracked:
        return tracked[-1].reason
    return problems[0] if problems else "there is no frame"
