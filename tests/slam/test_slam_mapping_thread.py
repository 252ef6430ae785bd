"""Mapping in a thread: tracking does not wait for it, and the results are as good."""

import os
import sys
import threading
import time
from concurrent.futures import Future

import numpy as np
import pytest
from slam_rides import CAMERA, CAMERAS, RGBD, STEREO, rendered, ride

from epipole.errors import ConfigError
from epipole.geometry import Similarity3
from epipole.metrics import absolute_error
from epipole.pipelines.slam import mapping_thread
from epipole.pipelines.slam.frames import Frame, SlamCamera, TrackingState
from epipole.pipelines.slam.loops.closing import LoopConstraint
from epipole.pipelines.slam.map.insertion import KeyframeInserter
from epipole.pipelines.slam.map.local_mapping import LocalMapper
from epipole.pipelines.slam.map.map_copy import MapCopy
from epipole.pipelines.slam.mapping_thread import MOST_WAITING, Mapped
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.start import one_camera
from whole import in_whole_run

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


def test_one_camera(monkeypatch):
    # The frame at which the map starts must not depend on the machine's load.
    monkeypatch.setattr(one_camera, "LONGEST_WAIT_S", 60.0)
    slam = Slam(CAMERAS["mono"], mapping="thread")
    answers = [slam.track(frame) for frame in ride().frames("mono")]
    assert sum(answer.state is TrackingState.TRACKING for answer in answers) >= 24
    slam.finish()
    path = slam.trajectory().world_from_body
    assert absolute_error(path, ride().truth(), "similarity").position.rmse < 0.006


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has priorities of threads")
def test_tracking_comes_first():
    def niceness():
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    thread = mapping_thread.MappingThread()
    own = niceness()
    for pool in (thread._pool, thread.judges):
        assert pool.submit(niceness).result() == min(19, own + mapping_thread.NICENESS)
    assert niceness() == own == thread._searchers.submit(niceness).result()


@pytest.fixture
def gate(monkeypatch):
    """Mapping that does not end before the gate is opened."""
    opened, adjust = threading.Event(), LocalMapper.adjust_around

    def later(mapper, newest):
        assert opened.wait(200.0)
        adjust(mapper, newest)

    monkeypatch.setattr(LocalMapper, "adjust_around", later)
    yield opened
    opened.set()


def test_no_frame_waits_for_mapping(gate, monkeypatch):
    monkeypatch.setattr(mapping_thread, "MOST_WAITING", 100)
    slam = Slam(STEREO, mapping="thread")
    answers = []
    for frame in ride().frames("stereo"):
        answers.append(slam.track(frame))  # would never return
        slam.mapping_thread._searchers.submit(bool).result()  # the search for points is not what is tested
    assert all(answer.has_pose for answer in answers)
    keyframes = sum(answer.is_keyframe for answer in answers)
    assert keyframes >= 5
    gate.set()
    slam.finish()
    # The first is the map's initialization, the second the gate's; those that waited were mapped together.
    assert slam.mapping_thread.num_merged == keyframes - 3
    final = absolute_error(slam.trajectory().world_from_body, ride().truth(), "none")
    assert final.position.rmse < 0.015


def test_no_frame_waits_for_the_points_of_a_keyframe(monkeypatch):
    opened, find_points = threading.Event(), KeyframeInserter.find_points
    slam = Slam(STEREO, mapping="thread")
    frames = ride().frames("stereo")
    first = slam.track(frames[0])

    def later(inserter, *arguments):
        assert opened.wait(60.0)
        return find_points(inserter, *arguments)

    monkeypatch.setattr(KeyframeInserter, "find_points", later)
    answers = [first]
    while sum(answer.is_keyframe for answer in answers) < 2:
        answers.append(slam.track(frames[len(answers)]))
    answers += [slam.track(frame) for frame in frames[len(answers) : len(answers) + 3]]
    newest = slam.map.keyframes[-1]
    assert all(answer.has_pose for answer in answers) and not answers[-1].is_keyframe
    assert len(slam.map.keyframes) == 2 and np.isnan(newest.disparity_px).all()
    tracked, known = len(newest.point), set(slam.odometry.tracker.tracks.point.tolist())
    opened.set()
    slam.wait_for_mapping()
    assert len(newest.point) > tracked and np.isfinite(newest.disparity_px).mean() > 0.5
    # The added points are tracked from the keyframe, three frames ago, and the pose agrees with them.
    added = [k for k, row in enumerate(slam.odometry.tracker.tracks.point) if int(row) not in known]
    assert len(added) > 20
    tracks, pose = slam.odometry.tracker.tracks, slam.odometry.cam_from_world
    seen = [k for k in added if slam.map.is_triangulated(tracks.point[[k]])[0]]
    off = CAMERA.project(pose.apply(slam.map.xyz[tracks.point[seen]])) - tracks.pixels[seen]
    assert np.median(np.linalg.norm(off, axis=1)) < 0.5
    for frame in frames[len(answers) :]:
        assert slam.track(frame).has_pose
    slam.finish()
    final = absolute_error(slam.trajectory().world_from_body, ride().truth(), "none")
    assert final.position.rmse < 0.015


def raised_while_tracking(slam):
    """Number of errors; each frame that raised one is tracked again."""
    raised = 0
    for frame in ride().frames("rgbd"):
        try:
            slam.track(frame)
        except MemoryError:
            raised += 1
            slam.track(frame)
    slam.finish()
    return raised


def test_an_error_of_the_search_is_raised_once(monkeypatch):
    failures, find_points = [], KeyframeInserter.find_points
    slam = Slam(RGBD, mapping="thread")

    def fail_once(inserter, *arguments):
        if len(slam.map.keyframes) > 1 and not failures:
            failures.append(1)
            raise MemoryError("no room")
        return find_points(inserter, *arguments)

    monkeypatch.setattr(KeyframeInserter, "find_points", fail_once)
    raised = raised_while_tracking(slam)
    assert raised == len(failures) == 1
    final = absolute_error(slam.trajectory().world_from_body, ride().truth(), "none")
    assert len(slam.trajectory()) == 30 and final.position.rmse < 0.015  # a keyframe without new points


def watched_adjustment(monkeypatch, is_over):
    """Mapping that does not end before the thread is asked to; the list of the answers to whether it may go on."""
    asked, adjust = [], LocalMapper.adjust_around

    def later(mapper, newest):
        until = time.monotonic() + 20.0
        while mapper.goes_on() and time.monotonic() < until and not is_over():
            time.sleep(0.01)
        asked.append(mapper.goes_on())
        adjust(mapper, newest)

    monkeypatch.setattr(LocalMapper, "adjust_around", later)
    return asked


def test_a_lost_frame_ends_the_adjustment(monkeypatch):
    slam, is_over = Slam(RGBD, mapping="thread"), threading.Event()
    asked = watched_adjustment(monkeypatch, is_over.is_set)
    frames = ride().frames("rgbd")
    while not slam.mapping_thread.num_waiting:
        slam.track(frames[slam._num_frames])
    blank = Frame(99.0, np.full_like(frames[0].gray, 127), depth=frames[0].depth)
    assert not slam.track(blank).has_pose
    assert asked and not any(asked) and not slam.mapping_thread.is_urgent
    is_over.set()


def test_keyframes_that_wait_end_the_adjustment(monkeypatch):
    slam, is_over = Slam(RGBD, mapping="thread"), threading.Event()
    asked = watched_adjustment(monkeypatch, is_over.is_set)
    monkeypatch.setattr(mapping_thread, "LONGEST_WAIT_S", 20.0)
    frames = ride().frames("rgbd")
    while not slam.mapping_thread.num_waiting:
        slam.track(frames[slam._num_frames])
    slam.mapping_thread.num_waiting = MOST_WAITING + 1
    slam.track(frames[slam._num_frames])
    is_over.set()
    assert asked and not asked[0]


def test_an_urgent_wait_ends_with_an_error(monkeypatch):
    slam = Slam(RGBD, mapping="thread")
    frames = ride().frames("rgbd")
    slam.track(frames[0])

    def fail(**_):
        raise MemoryError("no room")

    monkeypatch.setattr(slam.mapping_thread, "take", fail)
    with pytest.raises(MemoryError):
        slam.wait_for_mapping(is_urgent=True)
    assert not slam.mapping_thread.is_urgent


def test_with_many_keyframes_waiting_a_frame_waits_a_little(gate, monkeypatch):
    monkeypatch.setattr(mapping_thread, "LONGEST_WAIT_S", 0.3)
    slam = Slam(RGBD, mapping="thread")
    for frame in ride().frames("rgbd"):
        slam.track(frame)
    thread = slam.mapping_thread
    for waiting, least, most in ((MOST_WAITING, 0.0, 0.25), (MOST_WAITING + 1, 0.25, 30.0)):
        thread.num_waiting, start = waiting, time.monotonic()
        assert thread.take() is None
        assert least <= time.monotonic() - start < most


@in_whole_run
def test_keyframes_become_rare_while_mapping_is_behind(gate):
    frames = rendered("loop_room", 120, 2).frames("rgbd")
    camera = rendered("loop_room", 120, 2).sensor("rgbd")
    slow = Slam(camera, mapping="thread")
    rare = []
    for frame in frames:
        rare.append(slow.track(frame))
        # Frames come faster than from a camera: without the points, tracking would be lost, and wait for mapping.
        slow.mapping_thread._searchers.submit(bool).result()
    gate.set()
    slow.finish()
    usual = Slam(camera)
    often = [usual.track(frame) for frame in frames]
    assert all(answer.has_pose for answer in rare)
    assert sum(a.is_keyframe for a in rare) < sum(a.is_keyframe for a in often)


def test_merged_keyframes_are_described(gate, monkeypatch):
    monkeypatch.setattr(mapping_thread, "MOST_WAITING", 100)
    slam = Slam(STEREO, mapping="thread")
    for frame in ride().frames("stereo"):
        slam.track(frame)
    gate.set()
    slam.wait_for_mapping()
    assert slam.mapping_thread.num_merged > 0
    assert all(keyframe.descriptor is not None for keyframe in slam.map.keyframes)


def test_an_error_of_the_thread_is_raised_once(monkeypatch):
    failures, adjust = [], LocalMapper.adjust_around

    def fail_once(mapper, newest):
        if not failures:
            failures.append(newest)
            raise MemoryError("no room")
        adjust(mapper, newest)

    monkeypatch.setattr(LocalMapper, "adjust_around", fail_once)
    slam = Slam(RGBD, mapping="thread")
    raised = raised_while_tracking(slam)
    assert raised == len(failures) == 1
    final = absolute_error(slam.trajectory().world_from_body, ride().truth(), "none")
    assert len(slam.trajectory()) == 30 and final.position.rmse < 0.01


def test_a_discarded_map_takes_over_nothing(gate):
    slam = Slam(RGBD, mapping="thread")
    for frame in ride().frames("rgbd"):
        slam.track(frame)
    gate.set()
    slam.mapping_thread.discard()
    assert slam.mapping_thread.take(wait=True) is None and not slam.mapping_thread.num_waiting


def test_an_interrupted_wait_loses_nothing(gate, monkeypatch):
    slam = Slam(RGBD, mapping="thread")
    for frame in ride().frames("rgbd"):
        slam.track(frame)

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Future, "result", interrupt)
        slam.wait_for_mapping()
    gate.set()
    slam.finish()
    final = absolute_error(slam.trajectory().world_from_body, ride().truth(), "none")
    assert final.position.rmse < 0.01


def test_joined_maps_keep_the_motion_since_the_newest_keyframe(monkeypatch):
    """A second map of the same frames is joined while tracking is some frames past its newest keyframe."""
    frames = ride().frames("rgbd")
    first, slam = Slam(RGBD), Slam(RGBD, mapping="thread")
    for frame in frames[:10]:
        first.track(frame)
    for n, frame in enumerate(frames):
        answer = slam.track(frame)
        slam.wait_for_mapping()
        if n > 20 and not answer.is_keyframe:
            break
    newest = slam.map.keyframes[-1]
    since = slam.odometry.cam_from_world @ newest.cam_from_world.inverse()
    assert np.linalg.norm(since.translation) > 0.01
    first.map.number = 7
    slam.maps.insert(0, first.map)
    same = Similarity3(np.array(1.0), np.eye(3), np.zeros(3))
    joining = LoopConstraint(first.map, 0, same, None)
    done = Mapped(MapCopy(slam.map), slam.odometry.mapper, joining, 1)
    results = iter([done, None])
    monkeypatch.setattr(slam.mapping_thread, "take", lambda **_: next(results))
    slam.wait_for_mapping()
    assert slam.maps == [first.map] and slam.map is first.map and slam.map.keyframes[-1] is newest
    now = slam.odometry.cam_from_world @ newest.cam_from_world.inverse()
    np.testing.assert_allclose(now.translation, since.translation, atol=1e-9)
    np.testing.assert_allclose(now.rotation, since.rotation, atol=1e-9)
    monkeypatch.undo()
    assert slam.track(frames[n + 1]).has_pose


@in_whole_run
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
