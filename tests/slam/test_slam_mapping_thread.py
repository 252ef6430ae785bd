"""Mapping in a thread: tracking does not wait for it, and the results are as good."""

import threading

import numpy as np
import pytest
from slam_rides import CAMERA, CAMERAS, RGBD, STEREO, rendered, ride

from epipole.errors import ConfigError
from epipole.metrics import absolute_error
from epipole.pipelines.slam import mapping_thread
from epipole.pipelines.slam.frames import SlamCamera, TrackingState
from epipole.pipelines.slam.map.local_mapping import LocalMapper
from epipole.pipelines.slam.slam import Slam

pytestmark = pytest.mark.usefixtures("unchecked_module")


@pytest.mark.parametrize(("kind", "most_cm"), [("rgbd", 1.0), ("stereo", 1.5)])
def test_the_path_is_as_good(kind, most_cm):
    slam = Slam(CAMERAS[kind], mapping="thread")
    answers = [slam.track(frame) for frame in ride().frames(kind)]
    assert all(answer.state is TrackingState.TRACKING for answer in answers)
    slam.finish()
    final = absolute_error(slam.trajectory().world_from_body, ride().truth(), "none")
    assert final.position.rmse < 0.01 * most_cm and final.rotation_deg.max < 0.5
    for keyframe in slam.map.keyframes:
        rotation = keyframe.cam_from_world.rotation
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)


def test_one_camera():
    slam = Slam(CAMERAS["mono"], mapping="thread")
    answers = [slam.track(frame) for frame in ride().frames("mono")]
    assert sum(answer.state is TrackingState.TRACKING for answer in answers) >= 24
    slam.finish()
    path = slam.trajectory().world_from_body
    assert absolute_error(path, ride().truth(), "similarity").position.rmse < 0.006


@pytest.fixture
def gate(monkeypatch):
    """Mapping that does not end before the gate is opened."""
    opened, adjust = threading.Event(), LocalMapper.adjust_around

    def later(mapper, newest):
        assert opened.wait(60.0)
        adjust(mapper, newest)

    monkeypatch.setattr(LocalMapper, "adjust_around", later)
    yield opened
    opened.set()


def test_no_frame_waits_for_mapping(gate):
    slam = Slam(STEREO, mapping="thread")
    answers = [slam.track(frame) for frame in ride().frames("stereo")]  # would never return
    assert all(answer.has_pose for answer in answers)
    keyframes = sum(answer.is_keyframe for answer in answers)
    assert keyframes >= 3
    gate.set()
    slam.finish()
    # The first is the map's initialization, the second the gate's; those that waited were mapped together.
    assert slam.mapping_thread.num_merged == keyframes - 3
    final = absolute_error(slam.trajectory().world_from_body, ride().truth(), "none")
    assert final.position.rmse < 0.015


def test_keyframes_become_rare_while_mapping_is_behind(gate):
    frames = rendered("loop_room", 120, 2).frames("rgbd")
    camera = rendered("loop_room", 120, 2).sensor("rgbd")
    slow = Slam(camera, mapping="thread")
    rare = [slow.track(frame) for frame in frames]
    gate.set()
    slow.finish()
    usual = Slam(camera)
    often = [usual.track(frame) for frame in frames]
    assert all(answer.has_pose for answer in rare)
    assert sum(a.is_keyframe for a in rare) < sum(a.is_keyframe for a in often)


def test_an_error_of_the_thread_is_raised_by_the_next_frame(monkeypatch):
    def fail(*_):
        raise MemoryError("no room")

    slam, frames = Slam(RGBD, mapping="thread"), ride().frames("rgbd")
    monkeypatch.setattr(mapping_thread, "_mapped", fail)
    with pytest.raises(MemoryError, match="no room"):
        for frame in frames:
            slam.track(frame)


def test_loops_are_closed_on_the_copy():
    room = rendered("loop_room", 379, 6)
    slam = Slam(room.sensor("rgbd", 0.93), mapping="thread")
    for frame in room.frames("rgbd"):
        slam.track(frame)
        slam.wait_for_mapping()
    assert sum(loop.verdict == "accepted" for loop in slam.loops) == 1
    slam.finish()
    assert len(slam.trajectory()) == len(room.images)


def test_a_rolling_shutter_is_refused():
    with pytest.raises(ConfigError, match="global shutter"):
        Slam(SlamCamera(CAMERA, readout_s=0.02), mapping="thread")
