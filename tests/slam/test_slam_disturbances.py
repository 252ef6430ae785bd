"""What cameras meet: a thing that walks, a hand before the lens, exposure that jumps, gaps, rest, and more threads."""

import numpy as np
import pytest
from slam_rides import RGBD, STEREO, errors, rendered, ride, tracked

from epipole import _parallel
from epipole.metrics import absolute_error
from epipole.pipelines.slam.frames import Frame, TrackingState
from epipole.pipelines.slam.output.warnings import warnings
from epipole.pipelines.slam.slam import Slam
from whole import IS_WHOLE, in_whole_run

pytestmark = pytest.mark.usefixtures("unchecked_module")  # long rides; others have had the types checked


def walking():
    return rendered("walking_box", 240, 4)


@pytest.mark.parametrize(
    ("kind", "alignment", "most_m"), [("rgbd", "none", 0.01)] + IS_WHOLE * [("mono", "similarity", 0.02)]
)
def test_a_box_that_walks_does_not_take_the_camera_along(kind, alignment, most_m):
    """It covers up to a third of the image, with more corners than the room behind; it goes 3 m, the camera 1.7."""
    slam = Slam(walking().sensor(kind))
    answers = [slam.track(frame) for frame in walking().frames(kind)]
    waiting = sum(a.state is not TrackingState.TRACKING for a in answers)
    assert waiting <= (0 if kind == "rgbd" else 3)
    found = errors(slam, walking().truth(), alignment)
    assert found.position.rmse < most_m and found.position.max < 3 * most_m
    truth = walking().truth().translation
    resting = [n for n in range(len(answers)) if 92 <= 4 * n <= 148]
    assert np.linalg.norm(np.diff(truth[resting], axis=0), axis=1).max() < 1e-6
    if kind == "rgbd":
        positions = np.array([answers[n].world_from_body.translation for n in resting])
        assert np.linalg.norm(positions - positions[0], axis=1).max() < 0.01  # the box crosses meanwhile
    moving = {4 * n: a.moving for n, a in enumerate(answers) if a.moving is not None}
    assert len(moving) >= 5 and all(60 <= number <= 184 for number in moving)  # it is in sight there
    (warning,) = warnings(answers, slam.trajectory())
    assert "an object moves in" in warning


@pytest.mark.parametrize(("kind", "shade"), [("stereo", 0), ("rgbd", 3)] + IS_WHOLE * [("stereo", 255)])
def test_while_the_lens_is_covered_nothing_is_claimed(kind, shade):
    frames = ride().frames(kind)[:16]
    covered = list(frames)
    noise = np.random.default_rng(4)
    for n in range(6, 9):
        pair = [
            noise.normal(shade, 2.0, frames[n].gray.shape).clip(0, 255).astype(np.uint8) for _ in range(2)
        ]
        right = pair[1] if kind == "stereo" else None
        covered[n] = Frame(frames[n].timestamp_s, pair[0], right, frames[n].depth)
    slam, answers = tracked(covered, STEREO if kind == "stereo" else RGBD)
    assert [a.state for a in answers[6:9]] == [TrackingState.LOST] * 3
    assert all(a.world_from_body is None and a.covariance is None for a in answers[6:9])
    assert all("agree with the map" in a.reason for a in answers[6:9])
    assert [a.state for a in answers[9:]] == [TrackingState.TRACKING] * 7  # at once
    rows = np.r_[0:6, 9:16]
    path = slam.trajectory()
    np.testing.assert_array_equal(np.rint(10 * path.timestamp_s), rows)
    assert absolute_error(path.world_from_body, ride().truth()[rows], "none").position.max < 0.03


@pytest.mark.parametrize("gain", [0.4] + IS_WHOLE * [1.5])
def test_exposure_may_jump(gain):
    """From one image to the next, and back again."""
    frames = []
    for n, frame in enumerate(ride().frames("rgbd")[:18]):
        gray = np.rint(frame.gray * (gain if 6 <= n < 12 else 1.0)).clip(0, 255).astype(np.uint8)
        frames.append(Frame(frame.timestamp_s, gray, None, frame.depth))
    slam, answers = tracked(frames, RGBD)
    assert all(a.state is TrackingState.TRACKING for a in answers)
    assert errors(slam, ride().truth(), "none").position.max < 0.02


@pytest.mark.parametrize("gap", [6] + IS_WHOLE * [3])
def test_frames_may_be_missing(gap):
    frames = [f for n, f in enumerate(ride().frames("rgbd")[:24]) if not 8 <= n < 8 + gap]
    slam, answers = tracked(frames, RGBD)
    assert all(a.state is TrackingState.TRACKING for a in answers)
    assert errors(slam, ride().truth(), "none").position.max < 0.02


def test_a_camera_at_rest_stays_within_two_millimeters():
    """One image with fresh noise, thirty times."""
    still = ride("rest", 1)
    noise = np.random.default_rng(5)
    frames = []
    for n in range(30):
        gray = still.left[0] + noise.normal(0, 2.0, still.left[0].shape)
        frames.append(Frame(0.1 * n, np.rint(gray).clip(0, 255).astype(np.uint8), None, still.depth[0]))
    slam, answers = tracked(frames, RGBD)
    assert all(a.state is TrackingState.TRACKING for a in answers)
    assert sum(a.is_keyframe for a in answers) <= 4
    positions = np.array([a.world_from_body.translation for a in answers])
    assert np.linalg.norm(positions, axis=1).max() < 2e-3
    assert np.linalg.norm(slam.trajectory().world_from_body.translation, axis=1).max() < 2e-3


@in_whole_run
@pytest.mark.parametrize("kind", ["rgbd"] + IS_WHOLE * ["mono"])
def test_the_same_path_on_one_thread_and_on_two(kind):
    """A sub-map and a camera that is found again among it: to the last bit."""
    room, found = rendered("loop_room", 54, 6), []
    frames = room.frames(kind, [*range(0, 54, 6), *range(0, 54, 6), *range(18, 36, 6)])
    for n in range(9, 18):  # upside down the room is another one
        depth = None if frames[n].depth is None else frames[n].depth[::-1].copy()
        frames[n] = Frame(frames[n].timestamp_s, frames[n].gray[::-1].copy(), None, depth)
    try:
        for threads in (1, 2):
            _parallel.set_num_threads(threads)
            slam, answers = tracked(frames, room.sensor(kind))
            slam.finish()
            paths = [slam.trajectory(number) for number in range(len(slam.maps))]
            found.append((paths, [(a.state, a.reason, a.num_points) for a in answers], slam.loops))
    finally:
        _parallel.set_num_threads(None)
    (paths, answers, loops), (others, again, loops_again) = found
    assert {TrackingState.TRACKING, TrackingState.LOST, TrackingState.SUBMAP} <= {
        state for state, *_ in answers
    }
    assert answers == again and loops == loops_again and len(paths) == len(others)
    for one, other in zip(paths, others, strict=True):
        np.testing.assert_array_equal(one.world_from_body.translation, other.world_from_body.translation)
        np.testing.assert_array_equal(one.world_from_body.rotation, other.world_from_body.rotation)
        np.testing.assert_array_equal(one.covariance, other.covariance)
