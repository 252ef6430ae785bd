"""A stopped run: frames that can be read again are tracked again; a live run keeps its answers and is relocalized in its saved map."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from slam_rides import CAMERAS, ride, write_pairs

from epipole.errors import ConfigError, FileFormatError, WorkspaceError
from epipole.geometry import Rigid3
from epipole.io import read_trajectory
from epipole.io.trajectories.frame_tables import read_frame_table
from epipole.metrics import absolute_error
from epipole.pipelines.slam import run
from epipole.pipelines.slam.output import autosave, resuming
from epipole.pipelines.slam.output.answer_log import ANSWERS, read_answers
from epipole.pipelines.slam.output.resuming import STARTED_AGAIN
from epipole.pipelines.slam.run import slam as run_slam
from epipole.pipelines.slam.sources.folder import FrameSource, QueuedFrame
from epipole.pipelines.slam.start import one_camera
from whole import IS_WHOLE, in_whole_run

WRITTEN = ("trajectory.txt", "trajectory_causal.txt", "trajectory_covariance.txt", "map/map.npz")


class CrashError(Exception):
    """What no part of the run knows of."""


def crash_at(count):
    """A progress that ends the run after so many frames."""

    def progress(report):
        if report.stage == "track" and report.done == count:
            raise CrashError

    return progress


def source_of(kind, count=30, first=0, **more):
    """Frames of the ride, from memory."""

    def frames():
        for n, frame in enumerate(ride().frames(kind)[first:count]):
            yield QueuedFrame(n, frame.timestamp_s, f"{n}.png", lambda frame=frame: frame)

    return FrameSource(CAMERAS[kind], count, frames, Rigid3.exp([0.1, 0, 0, 0, 0, 0.2]), **more)


@pytest.fixture
def source(monkeypatch, tmp_path):
    """Sets what is read, and how often the map is saved."""

    def put(kind, interval_s=0.0, **more):
        monkeypatch.setattr(run, "find_camera", lambda *_: None)
        monkeypatch.setattr(run, "_open", lambda *_: source_of(kind, **more))
        monkeypatch.setattr(autosave, "MIN_INTERVAL_S", interval_s)
        monkeypatch.setattr(autosave, "MAX_TIME_FRACTION", 1e9)
        return tmp_path

    (tmp_path / "ride").mkdir()
    return put


def written(out):
    return [(out / name).read_bytes() for name in WRITTEN]


@pytest.mark.parametrize(
    "options", [{}, {"start": 5, "stride": 3}] if IS_WHOLE else [{"start": 5, "stride": 3}]
)
def test_frames_that_can_be_read_again_are_tracked_again(options, source):
    """The result is that of an undisturbed run, and the trajectory so far can be read after the crash."""
    position = source("stereo")
    out = position / "out"
    run_slam(position / "ride", position / "whole", **options)
    assert not (position / "whole" / "checkpoint").exists()
    with pytest.raises(CrashError):
        run_slam(position / "ride", out, progress=crash_at(6), **options)
    assert sorted(p.name for p in (out / "checkpoint").iterdir()) == ["key.json", "trajectory_causal.txt"]
    assert len(read_trajectory(out / "checkpoint" / "trajectory_causal.txt")) == 6
    result = run_slam(position / "ride", out, **{**options, "resume": True})
    assert STARTED_AGAIN in result.warnings
    assert written(out) == written(position / "whole") and not (out / "checkpoint").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL there")
@pytest.mark.parametrize("mapping", ["inline"] + IS_WHOLE * ["thread"])
def test_a_killed_process_leaves_its_trajectory(tmp_path, mapping):
    folder, out = write_pairs(tmp_path / "ride", 12), tmp_path / "out"
    command = [sys.executable, "-m", "epipole", "slam", str(folder), str(out), "--mapping", mapping]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    path = out / "checkpoint" / "trajectory_causal.txt"
    while process.poll() is None and not (path.is_file() and path.read_bytes().count(b"\n") >= 5):
        time.sleep(0.001)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    assert 4 <= len(read_trajectory(path)) < 12 and not (out / "trajectory.txt").exists()
    if mapping == "thread":  # results depend on the machine's speed
        return
    run_slam(folder, out)
    run_slam(folder, tmp_path / "whole")
    assert written(out) == written(tmp_path / "whole")


def test_a_camera_that_starts_late_has_dropped_nothing(source):
    position = source("stereo", interval_s=3600.0, is_live=True)
    result = run_slam(position / "ride", position / "out", start=4, stride=2, max_frames=6)
    assert result.summary["num_dropped"] == 0 and result.summary["num_frames"] == 6
    with pytest.raises(CrashError):
        run_slam(position / "ride", position / "other", start=4, stride=2, progress=crash_at(5))
    found = run_slam(position / "ride", position / "other", start=4, stride=2, resume=True, max_frames=8)
    assert found.summary["num_dropped"] == 0


@pytest.mark.parametrize("interval_s", [0.0, 3600.0] if IS_WHOLE else [0.0])
def test_the_trajectory_of_a_camera_is_kept(interval_s, source):
    """Its frames come once: those of the first run are kept, and the second one continues in the map of the first."""
    position = source("stereo", interval_s=interval_s, is_live=True)
    with pytest.raises(CrashError):
        run_slam(position / "ride", position / "out", progress=crash_at(14))
    with pytest.raises(ConfigError, match=r"cannot be read again.*--resume"):
        run_slam(position / "ride", position / "out")
    source(
        "stereo", interval_s=interval_s, is_live=True, first=10
    )  # four of them are not later than what was seen
    result = run_slam(position / "ride", position / "out", resume=True, max_frames=32)
    assert result.summary["num_frames"] == 32 and result.summary["num_localized"] == 14 + 14
    assert [w.split(":")[0] for w in result.warnings] == [f"frame {n} is left out" for n in range(14, 18)]
    table = read_frame_table(position / "out" / "frames.csv")
    assert len(table.image) == 32 and np.isnan(table.timestamp_s[14:18]).all()
    body_from_camera = source_of("stereo").body_from_camera
    truth = ride().truth()[np.arange(28)] @ body_from_camera.inverse()
    for path in (result.causal, result.trajectory):
        assert np.allclose(path.timestamp_s, 0.1 * np.arange(28))
        assert absolute_error(path.world_from_body, truth, "none").position.rmse < 0.02


@in_whole_run
@pytest.mark.parametrize("kind", ["rgbd", "mono"])
def test_other_cameras_are_continued_too(kind, source, monkeypatch):
    # The frame at which a map starts must not depend on the machine's load.
    monkeypatch.setattr(one_camera, "LONGEST_WAIT_S", 60.0)
    position = source(kind, is_live=True)
    with pytest.raises(CrashError):
        run_slam(position / "ride", position / "out", progress=crash_at(20))
    source(kind, is_live=True, first=20)
    result = run_slam(position / "ride", position / "out", resume=True, max_frames=30)
    assert result.summary["num_frames"] == 30 and result.summary["num_localized"] >= 28
    assert not result.summary["num_dropped"] and len(result.causal) >= 20


def test_what_does_not_fit_is_refused(source, monkeypatch):
    position = source("stereo", is_live=True)
    out = position / "out"
    with pytest.raises(CrashError):
        run_slam(position / "ride", out, progress=crash_at(6))
    with pytest.raises(ConfigError, match=r"--num-features was 400 and is now 300.*to start again"):
        run_slam(position / "ride", out, resume=True, num_features=300)
    source("rgbd", is_live=True)
    with pytest.raises(ConfigError, match="the camera has changed"):
        run_slam(position / "ride", out, resume=True)
    source("stereo", is_live=True)
    monkeypatch.setattr(resuming, "__version__", "99.0")
    with pytest.raises(ConfigError, match=r"the version of epipole was .* and is now 99\.0"):
        run_slam(position / "ride", out, resume=True)
    assert len(read_answers(out / "checkpoint" / ANSWERS)) == 6


def test_damaged_files_are_refused_and_a_cut_log_is_not(source):
    position = source("stereo", is_live=True)
    out, fixed = position / "out", position / "out" / "checkpoint"
    with pytest.raises(CrashError):
        run_slam(position / "ride", out, progress=crash_at(8))
    kept = {path: path.read_bytes() for path in fixed.iterdir()}
    (saved_map,) = fixed.glob("map-*.npz")
    for path in (saved_map, fixed / "key.json"):
        data = bytearray(kept[path])
        data[len(data) // 2] ^= 255
        path.write_bytes(data)
        with pytest.raises(FileFormatError, match=r"damaged.*remove .* to start again"):
            run_slam(position / "ride", out, resume=True)
        path.write_bytes(kept[path])
    answers = fixed / ANSWERS
    first, *_, last = kept[answers].splitlines(keepends=True)
    for data, count in (
        (kept[answers] + kept[answers][:70], 8),
        (kept[answers][:-9], 7),
        (kept[answers] + first, 8),
        (last.replace(b'"num_points":', b'"num_points":-'), 0),
        (b"", 0),
    ):
        answers.write_bytes(data)
        assert len(read_answers(answers)) == count
    for data in (
        b"x" + kept[answers],
        kept[answers].replace(b'"number":3', b'"number":4'),
        first + kept[answers],
    ):
        answers.write_bytes(data)
        with pytest.raises(FileFormatError, match=r"line \d+ is damaged .*to start again"):
            run_slam(position / "ride", out, resume=True)
    answers.write_bytes(kept[answers] + kept[answers][:70])
    source("stereo", is_live=True, first=8)
    assert run_slam(position / "ride", out, resume=True, max_frames=20).summary["num_localized"] == 20


def test_a_folder_of_someone_elses_is_left_alone(source):
    position = source("stereo")
    (position / "out" / "checkpoint").mkdir(parents=True)
    (position / "out" / "checkpoint" / "mine.txt").write_text("mine")
    run_slam(position / "ride", position / "fresh", resume=True)  # nothing is there: it begins
    (position / "fresh" / "checkpoint").write_text("mine")
    with pytest.raises(WorkspaceError, match="checkpoint was not created by epipole"):
        run_slam(position / "ride", position / "fresh")


@in_whole_run
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT to itself there")
def test_ctrl_c_in_the_last_adjustment(source):
    """It is counted, and can be ended: what there is is written, and the rest can be made up for."""
    position, reports = source("stereo"), []

    def progress(report):
        if report.stage == "adjust":
            reports.append((report.done, report.total))
            if len(reports) == 3:
                os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        result = run_slam(position / "ride", position / "out", progress=progress)
    finally:
        signal.signal(signal.SIGINT, before)
    assert result.summary["interrupted"] and result.summary["num_localized"] == 30
    assert reports[:3] == [(0, 7), (1, 7), (2, 7)] and (3, 7) not in reports
    again = run_slam(position / "ride", position / "out", resume=True)
    run_slam(position / "ride", position / "whole")
    assert not again.summary["interrupted"] and written(position / "out") == written(position / "whole")
