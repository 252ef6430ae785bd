"""Live stereo: two cameras grabbed together, or one that delivers both images side by side."""

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from slam_rides import BASELINE, CAMERA, RIGHT_FROM_LEFT, ride

from epipole.errors import ConfigError, EpipoleError
from epipole.geometry import Rigid3
from epipole.io.calibration.files import CalibrationFile, write_calibration
from epipole.io.images.video_files import write_video
from epipole.metrics import absolute_error
from epipole.pipelines.slam.config import CameraOptions
from epipole.pipelines.slam.run import slam as run_slam
from epipole.pipelines.slam.sources import live_cameras
from epipole.pipelines.slam.sources.live_cameras import CameraPair, camera_indices, open_cameras
from whole import in_whole_run

COUNT = 12


class FakeCamera:
    """A capture that delivers each image once the previous one was taken; `log` has the calls of all cameras."""

    def __init__(self, name, images, log, times_s=None):
        self.name, self.images, self.log, self.times_s = name, list(images), log, times_s
        self.may_grab, self.is_released, self.num_grabbed = threading.Semaphore(2), False, 0

    def grab(self):
        self.log.append(("grab", self.name))
        self.num_grabbed += 1
        return self.may_grab.acquire(timeout=20) and self.num_grabbed <= len(self.images)

    def retrieve(self):
        self.log.append(("retrieve", self.name))
        return True, cv2.cvtColor(self.images[self.num_grabbed - 1], cv2.COLOR_GRAY2BGR)

    def read(self):
        return self.retrieve() if self.grab() else (False, None)

    def get(self, prop):
        assert prop == cv2.CAP_PROP_POS_MSEC
        return 0.0 if self.times_s is None else 1e3 * self.times_s[self.num_grabbed - 1]

    def release(self):
        self.is_released = True


@pytest.fixture
def rig_file(tmp_path):
    poses = Rigid3(
        np.stack([np.eye(3), RIGHT_FROM_LEFT.rotation]), np.stack([np.zeros(3), RIGHT_FROM_LEFT.translation])
    )
    write_calibration(tmp_path / "rig.json", CalibrationFile((CAMERA, CAMERA), poses), {})
    return tmp_path / "rig.json"


def pair(times_s=(None, None), log=None):
    """Two cameras; the first image of each is used to find the size."""
    log = [] if log is None else log
    sides = ride().left, ride().right
    return [
        FakeCamera(name, [images[0], *images[:COUNT]], log, times)
        for name, images, times in zip(("left", "right"), sides, times_s)
    ]


def opened_by(monkeypatch, cameras):
    monkeypatch.setattr(live_cameras, "_opened_camera", lambda index: cameras[index])


def paced(cameras):
    """Progress callback that lets the next images arrive."""
    return lambda report: report.stage == "compile" or [camera.may_grab.release() for camera in cameras]


def error_m(result) -> float:
    return absolute_error(result.trajectory.world_from_body, ride().truth()[:COUNT], "none").position.rmse


def test_two_cameras_are_a_metric_pair(tmp_path, rig_file, monkeypatch):
    log = []
    cameras = pair(log=log, times_s=[5.0 + 0.1 * np.arange(20)] * 2)
    opened_by(monkeypatch, cameras)
    result = run_slam("0,1", tmp_path / "out", calibration=rig_file, progress=paced(cameras))
    assert result.summary["num_localized"] == COUNT and result.summary["is_metric"]
    assert error_m(result) < 0.02
    assert result.summary["source"]["layout"] == "two cameras" and result.summary["is_live"]
    assert log[:4] == [("grab", "left"), ("grab", "right"), ("retrieve", "left"), ("retrieve", "right")]
    assert all(camera.is_released for camera in cameras)
    assert not any("synchronized" in warning for warning in result.warnings)


def test_cameras_that_are_not_synchronized_are_reported(tmp_path, rig_file, monkeypatch):
    times = 5.0 + 0.1 * np.arange(20)
    cameras = pair(times_s=[times, times + 0.013])
    opened_by(monkeypatch, cameras)
    result = run_slam("0,1", tmp_path / "out", calibration=rig_file, progress=paced(cameras))
    (said,) = [warning for warning in result.warnings if "synchronized" in warning]
    assert "13 ms apart in the median and 13 ms in the 95th percentile" in said


def test_without_time_stamps_of_the_driver_the_clock_measures():
    images = [np.zeros((4, 6), np.uint8)] * 4
    for lag_s, is_said in ((0.009, True), (0.001, False)):
        seconds = iter(np.cumsum([0.0, lag_s, 0.1] * 4))
        cameras = [FakeCamera(name, images, []) for name in ("left", "right")]
        both = CameraPair(*cameras, clock=lambda seconds=seconds: float(next(seconds)))
        assert both.notes() == []
        seen = both.read()
        assert [image.shape for image in seen] == [(4, 6, 3)] * 2
        assert [("9 ms" in note) for note in both.notes()] == [True] * is_said


@in_whole_run
def test_a_camera_delivers_both_images_side_by_side(tmp_path, rig_file, monkeypatch):
    images = [np.hstack([left, right]) for left, right in zip(ride().left, ride().right)]
    camera = FakeCamera("both", [images[0], *images[:COUNT]], [])
    opened_by(monkeypatch, [camera])
    result = run_slam("0", tmp_path / "out", sensor="stereo", calibration=rig_file, progress=paced([camera]))
    assert result.summary["num_localized"] == COUNT and result.summary["is_metric"]
    assert error_m(result) < 0.02
    assert result.summary["source"]["layout"] == "side by side" and camera.is_released
    assert abs(np.linalg.norm(RIGHT_FROM_LEFT.translation) - BASELINE) < 1e-12


def test_a_video_has_both_images_side_by_side(tmp_path, rig_file):
    both = [np.hstack([left, right]) for left, right in zip(ride().left[:COUNT], ride().right[:COUNT])]
    write_video(tmp_path / "ride.mp4", [np.repeat(image[..., None], 3, axis=2) for image in both], 10.0)
    result = run_slam(tmp_path / "ride.mp4", tmp_path / "out", sensor="stereo", calibration=rig_file)
    assert result.summary["num_localized"] == COUNT and result.summary["is_metric"]
    assert error_m(result) < 0.02
    assert result.summary["source"]["sensor"] == "stereo"
    with pytest.raises(ConfigError, match="pass a calibration of both"):
        run_slam(tmp_path / "ride.mp4", tmp_path / "none", sensor="stereo")
    halves = [np.repeat(image[..., None], 3, axis=2) for image in ride().left[:COUNT]]
    write_video(tmp_path / "one.mp4", halves, 10.0)
    with pytest.raises(EpipoleError, match="but the image is 160x240"):
        run_slam(tmp_path / "one.mp4", tmp_path / "one", sensor="stereo", calibration=rig_file)
    with pytest.raises(ConfigError, match="a video has no depth"):
        run_slam(tmp_path / "one.mp4", tmp_path / "rgbd", sensor="rgbd", calibration=rig_file)


def test_what_is_no_pair_is_refused_and_released(tmp_path, rig_file, monkeypatch):
    cameras = pair()
    opened_by(monkeypatch, cameras)
    with pytest.raises(ConfigError, match="pass a calibration of both cameras"):
        run_slam("0,1", tmp_path / "out")
    assert all(camera.is_released for camera in cameras)
    with pytest.raises(ConfigError, match="cameras 1 and 1: a stereo pair needs two different cameras"):
        run_slam("1,1", tmp_path / "out", calibration=rig_file)
    cameras = pair()
    cameras[1].images = [image[:200] for image in cameras[1].images]
    opened_by(monkeypatch, cameras)
    with pytest.raises(ConfigError, match="must have one size, got 320 x 240 and 320 x 200"):
        run_slam("0,1", tmp_path / "out", calibration=rig_file)
    cameras = pair()
    opened_by(monkeypatch, cameras)
    with pytest.raises(EpipoleError, match="but the image is 160x240"):  # the halves of an ordinary image
        run_slam("0", tmp_path / "out", sensor="stereo", calibration=rig_file)
    assert cameras[0].is_released


def test_a_missing_second_camera_releases_the_first(tmp_path, rig_file, monkeypatch):
    (left, _), opened = pair(), live_cameras._opened_camera
    monkeypatch.setattr(live_cameras, "_opened_camera", lambda index: opened(97) if index else left)
    with pytest.raises(ConfigError, match="camera 97 cannot be opened"):
        run_slam("0,1", tmp_path / "out", calibration=rig_file)
    assert left.is_released


def test_sources_that_name_cameras(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for source, indices in (
        ("0", (0,)),
        ("0,1", (0, 1)),
        ("12,3", (12, 3)),
        ("/dev/video4", (4,)),
        ("/dev/video0,/dev/video2", (0, 2)),
        ("0,1,2", ()),
        ("0,a", ()),
        ("1234", ()),
        ("ride", ()),
        ("ride,1", ()),
    ):
        assert camera_indices(Path(source)) == indices, source
    for name in ("0", "0,1"):
        (tmp_path / name).mkdir()
        assert camera_indices(Path(name)) == ()


@pytest.mark.parametrize("failure", [cv2.error("device lost"), OSError("device lost")])
def test_a_driver_that_fails_ends_the_frames_with_its_reason(failure):
    class Failing:
        released, count = False, 0

        def read(self):
            self.count += 1
            if self.count > 1:
                raise failure
            return True, np.zeros((240, 320), np.uint8)

        def release(self):
            self.released = True

    camera = Failing()
    given = CameraOptions(camera_params="260,260,160,120")
    source = open_cameras((0,), "mono", given, captures=[camera])
    with pytest.raises(ConfigError, match="device lost"):
        list(source.frames())
    assert camera.released
