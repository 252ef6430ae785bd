"""Recordings of ROS, videos and cameras become paths; real time drops and counts; Ctrl-C keeps what there is."""

import itertools
import json
import os
import signal
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from slam_rides import BASELINE, CAMERA, MONO, ride

from bag_writing import Recorded
from epipole.cameras import Camera
from epipole.cli.main import main
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.io import read_trajectory
from epipole.metrics import absolute_error
from epipole.pipelines.slam.config import CameraOptions, JobOptions
from epipole.pipelines.slam.frames import Frame
from epipole.pipelines.slam.run import slam as run_slam
from epipole.pipelines.slam.sources import live_cameras
from epipole.pipelines.slam.sources.folder import FrameSource, QueuedFrame, of_pair
from epipole.pipelines.slam.sources.frame_stream import Clock, FrameStream
from epipole.scene import StereoRig
from whole import IS_WHOLE, in_whole_run

PARAMS = ",".join(str(p + 0.5 * (n >= 2)) for n, p in enumerate(CAMERA.params))
KNOWN = {"camera_params": PARAMS}
BEGIN, STEP = 1_500_000_000 * 10**9, 10**8
FOCAL, _, CX, CY = CAMERA.params
K = np.array([[FOCAL, 0, CX], [0, FOCAL, CY], [0, 0, 1]])


def recorded_ride(kind: str, sensor: str, count: int = 12) -> Recorded:
    """A rendered ride as messages."""
    out, size = Recorded(kind), (CAMERA.width, CAMERA.height)
    for n in range(count):
        ns = BEGIN + n * STEP
        out.image("/cam/left/image_rect", ns, ride().left[n], "mono8")
        out.camera_info("/cam/left/camera_info", ns, size, K)
        if sensor == "stereo":
            out.image("/cam/right/image_rect", ns + 900_000, ride().right[n], "mono8")
            P = np.column_stack([K, [-FOCAL * BASELINE, 0, 0]])
            out.camera_info("/cam/right/camera_info", ns, size, K, P=P)
        if sensor == "rgbd":
            millimeters = np.rint(1000 * ride().depth[n]).astype(np.uint16)
            out.image("/cam/depth_registered/image_raw", ns + 8_000_000, millimeters, "16UC1")
    return out


def error_m(trajectory, alignment="none") -> float:
    rows = np.rint(10 * (trajectory.timestamp_s - trajectory.timestamp_s[0])).astype(int)
    return absolute_error(trajectory.world_from_body, ride().truth()[rows], alignment).position.rmse


@pytest.mark.parametrize(
    ("kind", "sensor"),
    [("mcap", "mono"), ("ros1", "rgbd"), ("sqlite", "stereo")]
    + IS_WHOLE * [("mcap", "stereo"), ("ros1", "stereo"), ("sqlite", "rgbd")],
)
def test_recordings_of_ros_become_paths(kind, sensor, tmp_path):
    path = recorded_ride(kind, sensor).write(tmp_path)
    result = run_slam(path, tmp_path / "out")
    assert result.summary["num_localized"] == 12 and not result.warnings
    assert result.trajectory.timestamp_s[0] == pytest.approx(BEGIN * 1e-9, abs=1e-6)
    assert error_m(result.trajectory, "similarity" if sensor == "mono" else "none") < 0.02
    assert result.summary["is_metric"] == (sensor != "mono")


def test_topics_are_chosen_on_the_command_line(tmp_path, capsys):
    path = recorded_ride("mcap", "stereo").write(tmp_path)
    main(["slam", str(path), str(tmp_path / "out"), "--topics", "/cam/left/image_rect", "--max-frames", "8"])
    assert "8 of 8" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["slam", str(path), str(tmp_path / "out"), "--topics", "/wrong"])
    said = capsys.readouterr().err
    assert "/wrong has no images" in said and "/cam/right/image_rect (12 of Image, image)" in said
    with pytest.raises(ConfigError, match="topics is for ROS bags"):
        run_slam(tmp_path, tmp_path / "o", topics="/a", **KNOWN)


def test_a_recording_that_was_cut_off_gives_the_path_before(tmp_path):
    path = recorded_ride("mcap", "stereo", 24).write(tmp_path)
    file = next(path.glob("*.mcap"))
    data = file.read_bytes()
    file.write_bytes(data[: int(0.7 * len(data))])
    result = run_slam(path, tmp_path / "out")
    assert 8 <= result.summary["num_localized"] < 20
    assert any("before the damage or truncation" in warning for warning in result.warnings)
    assert error_m(result.trajectory) < 0.02


def write_video(path: Path, images) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (CAMERA.width, CAMERA.height))
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def test_videos_whole_and_cut_off(tmp_path):
    path = write_video(tmp_path / "ride.avi", ride().left)
    result = run_slam(path, tmp_path / "out", **KNOWN)
    assert result.summary["num_localized"] == 30 and not result.warnings
    assert np.allclose(np.diff(result.trajectory.timestamp_s), 0.1, atol=1e-6)
    path.write_bytes(path.read_bytes()[: int(0.6 * path.stat().st_size)])
    result = run_slam(path, tmp_path / "cut", **KNOWN)
    assert 10 < result.summary["num_localized"] < 25
    assert error_m(result.trajectory, "similarity") < 0.03
    assert any("ends after" in warning and "of 30 announced frames" in warning for warning in result.warnings)


def test_a_video_without_frames(tmp_path):
    (tmp_path / "none.mp4").write_bytes(b"")
    with pytest.raises(FileFormatError, match=r"none\.mp4.*empty"):
        run_slam(tmp_path / "none.mp4", tmp_path / "out", **KNOWN)
    path = write_video(tmp_path / "head.avi", ride().left[:1])
    data = path.read_bytes()
    path.write_bytes(data[: data.index(b"movi")])
    with pytest.raises(FileFormatError, match=r"head\.avi"):
        run_slam(path, tmp_path / "out", **KNOWN)


def test_a_baseline_in_millimeters_is_questioned():
    camera = Camera("PINHOLE", 320, 240, np.array([260.0, 260.0, 159.5, 119.5]))
    shift = np.array([-120.0, 0.0, 0.0])
    turned = Rotation3.exp(np.array([0.0, 0.02, 0.0])).matrix
    for rotation in (np.eye(3), turned):
        (note,) = of_pair(StereoRig(camera, camera, Rigid3(rotation, shift))).notes()
        assert "120 m: if the calibration is in another unit" in note
        assert not of_pair(StereoRig(camera, camera, Rigid3(rotation, 1e-3 * shift))).notes()


class FakeCapture:
    """A camera that gives each image once the one before was taken, and then ends, or goes on."""

    def __init__(self, images):
        self.images, self.is_released = list(images), False
        self.may_read, self.num_calls = threading.Semaphore(2), 0

    def read(self):
        self.num_calls += 1
        if not self.may_read.acquire(timeout=20) or not self.images:
            return False, None
        return True, cv2.cvtColor(self.images.pop(0), cv2.COLOR_GRAY2BGR)

    def release(self):
        self.is_released = True


def opened_by(monkeypatch, capture):
    monkeypatch.setattr(live_cameras, "_opened_camera", lambda index: capture)


def paced(capture):
    """Progress callback that lets the next image arrive."""
    return lambda report: report.stage == "compile" or capture.may_read.release()


def test_a_camera_is_followed_until_it_ends(tmp_path, monkeypatch):
    """With mapping between the frames: a thread on a busy machine would compare starts beyond the last of so few frames."""
    capture = FakeCapture([ride().left[0], *ride().left[:14]])
    opened_by(monkeypatch, capture)
    result = run_slam("0", tmp_path / "out", **KNOWN, mapping="inline", progress=paced(capture))
    assert result.summary["num_frames"] == result.summary["num_localized"] == 14
    assert result.summary["is_live"] and result.summary["num_dropped"] == 0 and capture.is_released
    assert not result.summary["interrupted"]
    assert abs(result.trajectory.timestamp_s[0] - (tmp_path / "out").stat().st_mtime) < 600  # by the clock
    capture = FakeCapture([ride().left[0], *ride().left[:20]])
    opened_by(monkeypatch, capture)
    result = run_slam(
        *("0", tmp_path / "shorter"),
        **KNOWN,
        max_frames=9,
        progress=paced(capture),
    )
    assert result.summary["num_frames"] == 9 and capture.is_released


def test_a_slow_tracker_gets_the_newest_picture_of_a_camera():
    images = [np.full((240, 320), n, np.uint8) for n in range(12)]
    capture, seconds = FakeCapture(images), iter(range(100))
    source = live_cameras.open_cameras(
        (0,), "mono", CameraOptions(**KNOWN), (capture,), lambda: float(next(seconds))
    )
    stream, values = FrameStream(source, JobOptions()), []
    for queued in stream:
        values.append((queued.timestamp_s, int(queued.read().gray[0, 0])))
        for _ in range(3):  # while this one is followed three more come
            capture.may_read.release()
        # Another call begins when the image of the last is kept; the thirteenth, which fails, is the last.
        while capture.num_calls < min(3 + 3 * len(values), 13):
            time.sleep(0.002)
    # Image 0 told the size; the others have the clock's time of each.
    assert values == [(0.0, 1), (3.0, 4), (6.0, 7), (9.0, 10), (10.0, 11)]
    assert stream.num_dropped == 6 and capture.is_released


def test_where_there_is_no_camera(tmp_path, capfd):
    with pytest.raises(ConfigError, match="camera 97 cannot be opened"):
        run_slam("97", tmp_path / "out", **KNOWN)
    assert capfd.readouterr().err == ""
    with pytest.raises(ConfigError, match="a live camera has no depth"):
        run_slam("97", tmp_path / "out", **KNOWN, sensor="rgbd")
    with pytest.raises(ConfigError, match="two live cameras are a stereo pair"):
        run_slam("97,98", tmp_path / "out", **KNOWN, sensor="mono")


def test_a_camera_without_intrinsics_is_refused(tmp_path, monkeypatch):
    capture = FakeCapture(ride().left[:2])
    opened_by(monkeypatch, capture)
    with pytest.raises(ConfigError, match="unknown intrinsics of the live camera"):
        run_slam("0", tmp_path / "out")
    assert capture.is_released


def test_a_live_camera_has_no_finished_log_of_an_imu(tmp_path):
    (tmp_path / "imu.txt").write_text("".join(f"{0.005 * n} 0 0 0 0 0 9.81\n" for n in range(20)))
    (tmp_path / "mounting.yaml").write_text(f"T_cam_imu: {np.eye(4).tolist()}\n")
    given = {"imu": tmp_path / "imu.txt", "imu_mounting": tmp_path / "mounting.yaml"}
    with pytest.raises(ConfigError, match=r"Slam\.add_imu"):
        run_slam("0", tmp_path / "out", **given)


class FakeClock(Clock):
    """Passes only as it is told to."""

    def __init__(self):
        self.seconds = 50.0

    def now_s(self):
        return self.seconds

    def wait(self, seconds):
        self.seconds += seconds


def source_of(count: int, **more) -> FrameSource:
    def frames():
        for n in range(count):
            read = (lambda n=n: Frame(0.1 * n, ride().left[n])) if n < 30 else None
            yield QueuedFrame(n, 0.1 * n, f"{n}.png", read)

    return FrameSource(MONO, count, frames, Rigid3.identity(), **more)


@pytest.mark.parametrize(
    ("seconds", "expected"),
    [(0.03, list(range(20))), (0.25, [0, 1, 3, 6, 8, 11, 13, 16, 18, 19]), (5.0, [0, 1, 19])],
)
def test_real_time_takes_what_a_camera_would_give(seconds, expected):
    """Frames every 0.1 s, and a tracker that takes so long for each."""
    clock = FakeClock()
    stream, taken = FrameStream(source_of(20), JobOptions(realtime=True), clock=clock), []
    for queued in stream:
        taken.append(queued.number)
        clock.seconds += seconds
    assert taken == expected and stream.num_dropped == 20 - len(expected)


def test_all_frames_are_taken_otherwise():
    stream = FrameStream(source_of(20), JobOptions(), clock=FakeClock())
    assert [queued.number for queued in stream] == list(range(20)) and stream.num_dropped == 0
    stream = FrameStream(source_of(20), JobOptions(max_frames=7))
    assert len(list(stream)) == stream.num_expected == 7
    assert list(FrameStream(source_of(0), JobOptions(realtime=True))) == []


def test_dropped_frames_are_told(tmp_path, capsys, monkeypatch):
    """Two thousand images a second cannot be kept up with by a computer that takes a millisecond for each."""
    ticks = itertools.count()
    monkeypatch.setattr(Clock, "now_s", lambda _: 0.001 * next(ticks))
    for n in range(30):
        cv2.imwrite(str(tmp_path / f"{n:03d}.png"), ride().left[n])
    (tmp_path / "times.txt").write_text("\n".join(str(0.0005 * n) for n in range(30)))
    out = tmp_path / "out"
    with pytest.raises(SystemExit):
        main(["slam", str(tmp_path), str(out), "--camera-params", PARAMS, "--realtime", "--max-frames", "0"])
    assert "max-frames must be at least 1" in capsys.readouterr().err
    main(["slam", str(tmp_path), str(out), "--camera-params", PARAMS, "--realtime"])
    summary = json.loads((out / "summary.json").read_text())
    assert summary["num_dropped"] + summary["num_frames"] == 30 and 10 <= summary["num_dropped"] <= 20
    assert summary["mapping"] == "thread"
    said = " ".join(capsys.readouterr().out.split())
    assert f"frames dropped {summary['num_dropped']}, to keep up" in said


def stop_after(count: int):
    """A progress that presses Ctrl-C."""

    def progress(report):
        if report.stage == "track" and report.done == count:
            os.kill(os.getpid(), signal.SIGINT)

    return progress


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "pictures"
    path.mkdir()
    for n, image in enumerate(ride().left[:20]):
        cv2.imwrite(str(path / f"{n:03d}.png"), image)
    return path


@pytest.fixture
def heeding():
    """Ctrl-C as in a terminal: what runs in the background may be told to take no notice of it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT to itself there")
@pytest.mark.usefixtures("heeding")
def test_ctrl_c_writes_what_there_is(folder, tmp_path):
    result = run_slam(folder, tmp_path / "out", **KNOWN, progress=stop_after(15))
    assert result.summary["interrupted"] and result.summary["num_localized"] == 15
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["interrupted"] is True
    assert len(read_trajectory(tmp_path / "out" / "trajectory.txt")) == 15
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    again = run_slam(folder, tmp_path / "out", **KNOWN)
    assert again.summary["num_localized"] == 20 and not again.summary["interrupted"]


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT to itself there")
@pytest.mark.usefixtures("heeding")
def test_ctrl_c_twice_stops_at_once(folder, tmp_path):
    def progress(report):
        if report.done >= 5:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run_slam(
            *(folder, tmp_path / "out"),
            **KNOWN,
            progress=lambda report: [progress(report), progress(report)],
        )
    assert not (tmp_path / "out" / "trajectory.txt").exists()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@in_whole_run
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT to itself there")
@pytest.mark.usefixtures("heeding")
def test_the_command_tells_that_it_was_stopped(folder, tmp_path, capsys, monkeypatch):
    from epipole import screen

    shown = screen.progress_on_screen

    class Pressing:
        def __init__(self, *given):
            self.inner = shown(*given)

        def __enter__(self):
            show, press = self.inner.__enter__(), stop_after(12)
            return lambda report: [show(report), press(report)]

        def __exit__(self, *error):
            return self.inner.__exit__(*error)

    monkeypatch.setattr(screen, "progress_on_screen", Pressing)
    with pytest.raises(SystemExit) as stopped:
        main(["slam", str(folder), str(tmp_path / "out"), "--camera-params", PARAMS])
    said = capsys.readouterr().out
    assert stopped.value.code == 130 and "by Ctrl-C" in said and "12 of 12" in said


@pytest.mark.parametrize(
    ("format", "names"),
    [
        ("kitti", ["trajectory_kitti.txt", "trajectory_causal_kitti.txt"]),
        ("euroc", ["trajectory_euroc.csv", "trajectory_causal_euroc.csv"]),
        ("tum", []),
    ],
)
def test_paths_in_other_forms(tmp_path, format, names):
    path = recorded_ride("mcap", "stereo", 6).write(tmp_path)
    result = run_slam(path, tmp_path / "out", trajectory_format=format)
    written = sorted(p.name for p in (tmp_path / "out").glob("trajectory*"))
    tum = [f"trajectory{kind}.txt" for kind in ("", "_causal", "_covariance", "_causal_covariance")]
    assert written == sorted([*tum, *names])
    expected = read_trajectory(tmp_path / "out" / "trajectory.txt")
    for name in names[:1]:
        found = read_trajectory(tmp_path / "out" / name)
        assert np.allclose(found.world_from_body.translation, expected.world_from_body.translation, atol=1e-6)
        assert np.allclose(found.world_from_body.rotation, expected.world_from_body.rotation, atol=1e-6)
        if format == "euroc":
            assert np.allclose(found.timestamp_s, expected.timestamp_s, atol=1e-6)
    assert not result.warnings


def test_kitti_lines_that_are_no_frames_are_told(tmp_path):
    recorded = recorded_ride("mcap", "stereo", 6)
    recorded.rows[-4][3].encoding = "purple"
    path = recorded.write(tmp_path)
    result = run_slam(
        path, tmp_path / "out", trajectory_format="kitti", topics="/cam/left/image_rect /cam/right/image_rect"
    )
    assert any("1 frames have no pose: lines are not frame numbers" in warning for warning in result.warnings)
