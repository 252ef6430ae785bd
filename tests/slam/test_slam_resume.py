"""A run that was killed is gone on with: the result is that of a run that was not, to the last bit."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from slam_rides import CAMERAS, ride, write_pairs

from epipole.errors import ConfigError, FileFormatError, WorkspaceError
from epipole.geometry import Rigid3
from epipole.io import read_trajectory
from epipole.io.frame_tables import read_frame_table
from epipole.metrics import absolute_error
from epipole.pipelines.slam import checkpoint, resuming, run, state_files
from epipole.pipelines.slam.journal import JOURNAL, read_journal
from epipole.pipelines.slam.run import slam as run_slam
from epipole.pipelines.slam.source import FrameSource, QueuedFrame
from epipole.pipelines.slam.state_codec import BadState, Coded, decode, encode
from epipole.pipelines.slam.state_files import STATE

WRITTEN = ("trajectory.txt", "trajectory_causal.txt", "trajectory_covariance.txt", "map/map.npz")


class CrashError(Exception):
    """What no part of the run knows of."""


def crash_at(count):
    """A progress that ends the run after so many frames."""

    def progress(report):
        if report.stage == "track" and report.done == count:
            raise CrashError

    return progress


def source_of(kind, count=30, changed=None, first=0, **more):
    """Frames of the ride, from memory; one of them another picture."""

    def frames():
        for n, frame in enumerate(ride().frames(kind)[first:count]):
            if n == changed:
                frame = replace(frame, grey=255 - frame.grey)
            yield QueuedFrame(n, frame.timestamp_s, f"{n}.png", lambda frame=frame: frame)

    return FrameSource(CAMERAS[kind], count, frames, Rigid3.exp([0.1, 0, 0, 0, 0, 0.2]), **more)


@pytest.fixture
def source(monkeypatch, tmp_path):
    """Sets what is read, and whether the state is written with every frame."""

    def put(kind, pause_s=0.0, **more):
        monkeypatch.setattr(run, "find_camera", lambda *_: None)
        monkeypatch.setattr(run, "_open", lambda *_: source_of(kind, **more))
        monkeypatch.setattr(checkpoint, "PAUSE_S", pause_s)
        monkeypatch.setattr(checkpoint, "SHARE", 1e9)
        return tmp_path

    (tmp_path / "ride").mkdir()
    return put


def written(out):
    return [(out / name).read_bytes() for name in WRITTEN]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("kind", ["stereo", "rgbd", "mono"])
def test_the_result_is_that_of_a_whole_run(kind, source, monkeypatch):
    monkeypatch.setattr(state_files, "SPARE_BYTES", 0)  # what is of use is written anew again and again
    place = source(kind)
    whole = run_slam(place / "ride", place / "whole")
    assert not (place / "whole" / "checkpoint").exists()
    out, begins = place / "out", []
    for count in (4, 9, 20):
        with pytest.raises(CrashError):
            run_slam(place / "ride", out, resume=count > 4, progress=crash_at(count))
        entries = read_journal(out / "checkpoint" / JOURNAL)
        assert len(entries) == count and len(list((out / "checkpoint").glob("arrays-*"))) <= 1
        placed = [e for e in entries if e.record.answer.world_from_body is not None]
        told = (out / "checkpoint" / "trajectory_causal.txt").read_text().splitlines()
        assert len(told) == 1 + len(placed)  # and a header
    result = run_slam(
        place / "ride", out, resume=True, progress=lambda r: r.stage == "track" and begins.append(r.done)
    )
    assert begins[0] == 21 and written(out) == written(place / "whole")
    assert result.summary["loops"] == whole.summary["loops"]
    assert not (out / "checkpoint").exists()


@pytest.mark.parametrize(
    "options",
    [{"start": 3}, {"stride": 2}, {"start": 5, "stride": 3}, {"start": 2, "stride": 2, "max_frames": 11}],
)
def test_a_run_of_some_of_the_frames_is_gone_on_with(options, source):
    place = source("stereo")
    whole = run_slam(place / "ride", place / "whole", **options)
    out, reports = place / "out", []
    for count in (1, 4):
        with pytest.raises(CrashError):
            run_slam(place / "ride", out, resume=count > 1, progress=crash_at(count), **options)
    found = run_slam(place / "ride", out, resume=True, progress=reports.append, **options)
    assert written(out) == written(place / "whole")
    wanted = range(30)[options.get("start", 0) :: options.get("stride", 1)][: options.get("max_frames")]
    for result in (whole, found):
        assert result.summary["num_frames"] == len(wanted) and result.summary["num_dropped"] == 0
        table = read_frame_table(result.out / "frames.csv")
        assert [name for name in table.picture if name] == [f"{number}.png" for number in wanted]
    followed = [report for report in reports if report.stage == "track"]
    assert followed[0].done == 5 and {report.total for report in followed} == {len(wanted)}


def test_a_camera_that_starts_late_has_dropped_nothing(source):
    place = source("stereo", pause_s=3600.0, is_live=True)
    result = run_slam(place / "ride", place / "out", start=4, stride=2, max_frames=6)
    assert result.summary["num_dropped"] == 0 and result.summary["num_frames"] == 6
    with pytest.raises(CrashError):
        run_slam(place / "ride", place / "other", start=4, stride=2, progress=crash_at(5))
    found = run_slam(place / "ride", place / "other", start=4, stride=2, resume=True, max_frames=8)
    assert found.summary["num_dropped"] == 0


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL there")
def test_a_killed_process_is_gone_on_with(tmp_path):
    folder, out = write_pairs(tmp_path / "ride", 30), tmp_path / "out"
    command = [sys.executable, "-m", "epipole", "slam", str(folder), str(out)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    journal, path = out / "checkpoint" / JOURNAL, out / "checkpoint" / "trajectory_causal.txt"
    while process.poll() is None and not (journal.is_file() and journal.read_bytes().count(b"\n") >= 6):
        time.sleep(0.001)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    count = len(read_journal(journal))
    assert 6 <= count < 30 and not (out / "trajectory.txt").exists()
    assert len(read_trajectory(path)) >= count - 1  # killed between the two lines it lacks one
    run_slam(folder, out, resume=True)
    run_slam(folder, tmp_path / "whole")
    assert written(out) == written(tmp_path / "whole")


def test_the_path_of_a_camera_stands(source):
    """Its frames come once: those of the first run are kept, and the second one goes on in the map of the first."""
    place = source("stereo", pause_s=3600.0, is_live=True)
    with pytest.raises(CrashError):
        run_slam(place / "ride", place / "out", progress=crash_at(14))
    with pytest.raises(ConfigError, match=r"cannot be read again.*--resume"):
        run_slam(place / "ride", place / "out")
    source("stereo", pause_s=3600.0, is_live=True, first=10)  # four of them are not later than what was seen
    result = run_slam(place / "ride", place / "out", resume=True, max_frames=32)
    assert result.summary["num_frames"] == 32 and result.summary["num_placed"] == 14 + 14
    assert [w.split(":")[0] for w in result.warnings] == [f"frame {n} is left out" for n in range(14, 18)]
    table = read_frame_table(place / "out" / "frames.csv")
    assert len(table.picture) == 32 and np.isnan(table.timestamp_s[14:18]).all()
    body_from_camera = source_of("stereo").body_from_camera
    truth = ride().truth()[np.arange(28)] @ body_from_camera.inverse()
    for path in (result.causal, result.trajectory):
        assert np.allclose(path.timestamp_s, 0.1 * np.arange(28))
        assert absolute_error(path.world_from_body, truth, "none").position.rmse < 0.02


def test_what_does_not_fit_is_refused(source, monkeypatch):
    place = source("stereo")
    out, held = place / "out", place / "out" / "checkpoint"
    with pytest.raises(CrashError):
        run_slam(place / "ride", out, progress=crash_at(6))
    with pytest.raises(ConfigError, match=r"--num-features was 400, and is 300 now.*leave --resume out"):
        run_slam(place / "ride", out, resume=True, num_features=300)
    source("rgbd")
    with pytest.raises(ConfigError, match="the camera is another now"):
        run_slam(place / "ride", out, resume=True)
    source("stereo", changed=5)
    with pytest.raises(ConfigError, match=r"5\.png is not the picture that was followed"):
        run_slam(place / "ride", out, resume=True)
    source("stereo")
    (place / "ride" / "more.png").write_bytes(b"1")
    with pytest.raises(ConfigError, match="the source's files are others now"):
        run_slam(place / "ride", out, resume=True)
    (place / "ride" / "more.png").unlink()
    monkeypatch.setattr(resuming, "__version__", "99.0")
    with pytest.raises(ConfigError, match=r"the version of epipole was .* and is 99\.0 now"):
        run_slam(place / "ride", out, resume=True)
    assert len(read_journal(held / JOURNAL)) == 6
    begins = []
    run_slam(place / "ride", out, progress=lambda r: begins.append(r.done))
    assert begins[0] == 1 and not held.exists()


def test_a_damaged_checkpoint_is_refused_and_a_cut_journal_is_not(source):
    place = source("stereo")
    out, held = place / "out", place / "out" / "checkpoint"
    with pytest.raises(CrashError):
        run_slam(place / "ride", out, progress=crash_at(8))
    kept = {path: path.read_bytes() for path in held.iterdir()}
    (arrays,) = held.glob("arrays-*.bin")
    for path, words in (
        (held / STATE, "damaged"),
        (arrays, "not what was written"),
        (held / "key.json", "damaged"),
    ):
        data = bytearray(kept[path])
        data[len(data) // 2] ^= 255
        path.write_bytes(data)
        with pytest.raises(FileFormatError, match=words):
            run_slam(place / "ride", out, resume=True)
        path.write_bytes(kept[path])
    (held / JOURNAL).write_bytes(kept[held / JOURNAL][:-9])
    with pytest.raises(FileFormatError, match="lacks frames of the 8"):
        run_slam(place / "ride", out, resume=True)
    (held / JOURNAL).write_bytes(kept[held / JOURNAL] + kept[held / JOURNAL][:70])
    run_slam(place / "ride", out, resume=True)
    run_slam(place / "ride", place / "whole")
    assert written(out) == written(place / "whole")


def test_a_folder_of_someone_elses_is_left_alone(source):
    place = source("stereo")
    (place / "out" / "checkpoint").mkdir(parents=True)
    (place / "out" / "checkpoint" / "mine.txt").write_text("mine")
    run_slam(place / "ride", place / "fresh", resume=True)  # nothing is there: it begins
    (place / "fresh" / "checkpoint").write_text("mine")
    with pytest.raises(WorkspaceError, match="checkpoint is no folder of epipole's"):
        run_slam(place / "ride", place / "fresh")


def test_objects_are_stored_and_those_of_other_kinds_are_neither_stored_nor_made():
    class Popen:
        """Not one of SLAM's."""

    held = {"a": {3, 1}, "b": (None, True, 1.5, [np.float32(2.0)]), 7: np.eye(3)[:, ::-1].T}
    again = decode(Coded(*encode(held, {})[:2]), {})
    assert again.keys() == held.keys() and again["a"] == held["a"] and again["b"] == held["b"]
    np.testing.assert_array_equal(again[7], held[7])
    with pytest.raises(TypeError, match="Popen has no place in a checkpoint"):
        encode([Popen()], {})
    for structure in (
        ["object", "Popen", {}],
        ["object", "Keyframe", {"keep": 1}],
        ["object", "TrackingState", {}],
        ["object", "Frame", {"grey": 1}],
        ["array", 3],
        ["again", 0],
        ["known", "else"],
        ["call", "os.system", "x"],
        [],
        {"a": 1},
    ):
        with pytest.raises(BadState):
            decode(Coded(structure, []), {})


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT to itself there")
def test_ctrl_c_in_the_last_adjustment(source):
    """It is counted, and can be ended: what there is is written, and the rest can be made up for."""
    place, reports = source("stereo"), []

    def progress(report):
        if report.stage == "adjust":
            reports.append((report.done, report.total))
            if len(reports) == 3:
                os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        result = run_slam(place / "ride", place / "out", progress=progress)
    finally:
        signal.signal(signal.SIGINT, before)
    assert result.summary["interrupted"] and result.summary["num_placed"] == 30
    assert reports[:3] == [(0, 7), (1, 7), (2, 7)] and (3, 7) not in reports
    again = run_slam(place / "ride", place / "out", resume=True)
    run_slam(place / "ride", place / "whole")
    assert not again.summary["interrupted"] and written(place / "out") == written(place / "whole")
