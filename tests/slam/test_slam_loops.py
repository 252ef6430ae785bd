"""Loops: a true one is closed and takes the drift with it, a false one never is, a lost camera is found where it is."""

import copy

import numpy as np
import pytest
from slam_rides import errors, rendered

from epipole.geometry import Rigid3, Rotation3
from epipole.pipelines.slam.frames import Frame, TrackingState
from epipole.pipelines.slam.loops.closing import LoopCloser
from epipole.pipelines.slam.slam import Slam
from whole import IS_WHOLE, in_whole_run

pytestmark = pytest.mark.usefixtures("unchecked_module")  # long rides; others have had the types checked

COUNT, STEP, FORK = 379, 6, 55


def room():
    """Once around, and on to where frame 18 had been."""
    return rendered("loop_room", COUNT, STEP)


def off_between(slam: Slam, truth: Rigid3, first: int, second: int) -> tuple[float, float]:
    """Meters (or the map's units) and degrees by which the motion between two frames is wrong."""
    path = slam.trajectory()
    number = [int(np.flatnonzero(np.rint(10 * path.timestamp_s) == n)[0]) for n in (first, second)]
    ours = path.world_from_body[number[0]].inverse() @ path.world_from_body[number[1]]
    true = truth[first].inverse() @ truth[second]
    rotated = Rotation3(true.rotation.T @ ours.rotation).angle_rad()
    return float(np.linalg.norm(ours.translation - true.translation)), float(np.degrees(rotated))


WRONG_FOCALS = [("mono", 0.97), ("rgbd", 0.93)] if IS_WHOLE else [("mono", 0.97)]


@pytest.fixture(scope="module", params=WRONG_FOCALS, ids=lambda param: param[0])
def closed_and_open(request, unchecked_module):
    """A SLAM with a wrong focal length, and a copy of it that is kept from closing loops."""
    kind, factor = request.param
    frames = room().frames(kind)
    slam = Slam(room().sensor(kind, factor))
    for frame in frames[:FORK]:
        slam.track(frame)
    assert not any(loop.verdict == "accepted" for loop in slam.loops)
    without = copy.deepcopy(slam)
    answers = [slam.track(frame) for frame in frames[FORK:]]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LoopCloser, "consider", lambda *_: None)
        for frame in frames[FORK:]:
            without.track(frame)
    return kind, slam, without, answers


def test_a_loop_takes_the_drift_with_it(closed_and_open):
    _, slam, without, answers = closed_and_open
    accepted = [loop for loop in slam.loops if loop.verdict == "accepted"]
    assert len(accepted) == 1
    assert accepted[0].frame > FORK and accepted[0].keyframe <= 10 and accepted[0].num_agreeing >= 30
    at = answers[accepted[0].frame - FORK]
    assert at.is_keyframe and at.reason == "a loop was closed"
    assert not any(loop.verdict == "accepted" for loop in without.loops)
    truth, last = room().truth(), len(room().images) - 1
    # Sixty frames are a whole turn.
    with_loop, open_end = (off_between(one, truth, last - 60, last) for one in (slam, without))
    assert with_loop[1] < 0.5 and open_end[1] > 10 * with_loop[1]
    assert with_loop[0] < 0.02 and open_end[0] > 2 * with_loop[0]
    ours, theirs = (errors(one, truth, "similarity").position.rmse for one in (slam, without))
    assert theirs > 2 * ours and ours < 0.025, (ours, theirs)


def test_the_ledger_says_what_came_of_every_place(closed_and_open):
    _, slam, _, _ = closed_and_open
    assert {loop.verdict for loop in slam.loops} <= {"accepted", "waiting", "rejected"}
    assert all(loop.reason for loop in slam.loops)
    waiting = [loop for loop in slam.loops if loop.verdict == "waiting"]
    assert [w.reason for w in waiting[-2:]] == [
        "confirmed by 1 of 3 keyframes",
        "confirmed by 2 of 3 keyframes",
    ]


def tiled():
    return rendered("tiled_room", 216, 6, with_right=IS_WHOLE)


@pytest.mark.parametrize("kind", ["rgbd", "stereo", "mono"] if IS_WHOLE else ["rgbd"])
def test_places_that_only_look_the_same_are_never_tied(kind):
    """Four sides alike, more than half a turn: every loop that might be closed is false."""
    slam = Slam(tiled().sensor(kind))
    answers = [slam.track(frame) for frame in tiled().frames(kind)]
    assert all(a.state not in (TrackingState.LOST, TrackingState.SUBMAP) for a in answers)
    assert answers[-1].state is TrackingState.TRACKING
    tempting = [loop for loop in slam.loops if loop.num_agreeing >= 30]
    assert len(tempting) >= 20  # the images are the same
    assert all(loop.verdict == "rejected" for loop in slam.loops)
    assert all("since then would have an error of" in loop.reason for loop in tempting)
    alignment = "similarity" if kind == "mono" else "none"
    assert errors(slam, tiled().truth(), alignment).position.rmse < 0.01


# A camera that is carried off.


def test_carried_to_a_known_place_it_is_found_there():
    numbers = [*range(0, 102, 6), *range(24, 54, 6)]
    frames = room().frames("rgbd", numbers)
    dark = np.full_like(frames[0].gray, 3)
    # Covered on the way, so that nothing can be followed.
    covered = [Frame(f.timestamp_s, dark, None, f.depth) if n == 17 else f for n, f in enumerate(frames)]
    for images, lost in [(frames, [])] + IS_WHOLE * [(covered, [17])]:
        slam = Slam(room().sensor("rgbd"))
        answers = [slam.track(frame) for frame in images]
        assert [n for n, a in enumerate(answers) if a.state is TrackingState.LOST] == lost
        truth = room().truth(numbers)
        for n, answer in enumerate(answers):
            if answer.world_from_body is not None:
                off = answer.world_from_body.translation - truth.translation[n]
                assert np.linalg.norm(off) < 0.03, n


@in_whole_run
def test_one_camera_carried_to_a_known_place_is_found_there():
    numbers = [*range(0, 102, 6), *range(24, 54, 6)]
    slam = Slam(room().sensor("mono"))
    answers = [slam.track(frame) for frame in room().frames("mono", numbers)]
    assert [a.state for a in answers[17:]] == [TrackingState.TRACKING] * 5
    assert errors(slam, room().truth(numbers), "similarity").position.max < 0.02
    assert len(slam.maps) == 1


@in_whole_run
@pytest.mark.parametrize("kind", ["rgbd", "mono"] if IS_WHOLE else ["rgbd"])
def test_carried_off_and_back_then_walking_there_the_maps_become_one(kind):
    """The camera is in the first map when the places of the sub-map are seen again: the first one's world stays."""
    numbers = [*range(0, 72, 6), *range(162, 216, 6), *range(42, 204, 6)]
    back, slam = 12 + 9, Slam(room().sensor(kind))
    answers, num_maps = [], []
    for frame in room().frames(kind, numbers):
        answers.append(slam.track(frame))
        num_maps.append(len(slam.maps))
    away = answers[12:back]
    assert all(a.world_from_body is None for a in away)  # never a wrong place
    assert [a.state for a in away[:3]] == [TrackingState.LOST] * 3
    assert away[-1].state is TrackingState.SUBMAP and away[-1].submap_from_body is not None
    assert all(a.state is TrackingState.TRACKING for a in answers[back:])
    assert max(num_maps) == 2 and num_maps[-1] == 1
    assert sum(loop.verdict == "accepted" for loop in slam.loops) == 1
    joined = num_maps.index(1, back)
    assert answers[joined].reason == "a loop was closed"
    truth = room().truth(numbers)
    path = slam.trajectory()
    assert len(path) >= len(numbers) - 4  # the sub-map's frames have got their places in the first map
    assert (np.diff([k.number for k in slam.map.keyframes]) > 0).all()
    if kind == "mono":
        assert errors(slam, truth, "similarity").position.rmse < 0.015
        return
    assert errors(slam, truth, "none").position.rmse < 0.03
    for n in range(back, len(numbers)):
        off = answers[n].world_from_body.translation - truth.translation[n]
        assert np.linalg.norm(off) < 0.05, n  # the world did not change under way


def test_another_scene_is_a_map_of_its_own():
    """Never a place in the first map; nothing is joined."""
    numbers = range(0, 72, 6)
    elsewhere = tiled()
    frames = room().frames("rgbd", numbers)
    others = elsewhere.frames("rgbd")[: len(frames)]
    frames += [Frame(100 + f.timestamp_s, f.gray, None, f.depth) for f in others]
    slam = Slam(room().sensor("rgbd"))
    answers = [slam.track(frame) for frame in frames]
    assert all(a.world_from_body is None for a in answers[12:])
    assert answers[-1].state is TrackingState.SUBMAP and len(slam.maps) == 2
    assert all(loop.verdict == "rejected" for loop in slam.loops)
    assert len(slam.trajectory(0)) == 12 and len(slam.trajectory(1)) == 9
