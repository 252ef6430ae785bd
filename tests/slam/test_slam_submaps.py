"""A corridor with a blank wall: the loss is said, a map of its own begins, and it is joined where the begin is seen again."""

import json

import cv2
import numpy as np
import pytest
from slam_rides import errors, rendered

from epipole.io import read_trajectory
from epipole.metrics import absolute_error
from epipole.pipelines.slam.frames import TrackingState
from epipole.pipelines.slam.run import slam as run_slam
from epipole.pipelines.slam.slam import Slam
from whole import in_whole_run

pytestmark = pytest.mark.usefixtures("unchecked_module")  # long rides; others have had the types checked

STEP, BLANK, TEXTURE = 4, 97, 118
"""Frames 97 to 118 of the ride show the white wall alone."""


def corridor(count=620):
    return rendered("corridor", count, STEP)


@pytest.fixture(scope="module")
def whole(unchecked_module):
    slam = Slam(corridor().sensor("rgbd"))
    return slam, [slam.track(frame) for frame in corridor().frames("rgbd")]


@in_whole_run
def test_the_loss_is_said_at_the_blank_wall(whole):
    _, answers = whole
    first = next(n for n, a in enumerate(answers) if a.state is TrackingState.LOST)
    assert BLANK - 4 * STEP <= first * STEP <= BLANK + 3 * STEP
    for n, answer in enumerate(answers):
        if BLANK <= n * STEP <= TEXTURE:
            assert answer.state is TrackingState.LOST and answer.world_from_body is None
            assert answer.submap_from_body is None and answer.covariance is None
            assert "too few agree with the map" in answer.reason
    assert "blank" in answers[TEXTURE // STEP].reason


@in_whole_run
def test_meanwhile_places_are_those_of_a_map_of_its_own(whole):
    _, answers = whole
    away = [a for a in answers if a.state is TrackingState.SUBMAP]
    assert len(away) > 90
    assert all(a.world_from_body is None and a.submap_from_body is not None for a in away)
    known = [a for a in answers if a.state is TrackingState.TRACKING]
    assert all(a.world_from_body is not None and a.submap_from_body is None for a in known)
    started = [a for a in away if a.reason.startswith("a separate map was initialized")]
    assert 1 <= len(started) <= 2 and started[0].is_keyframe
    np.testing.assert_array_equal(
        started[0].submap_from_body.log(), np.zeros(6)
    )  # its world is its first frame


@in_whole_run
def test_seeing_the_begin_again_joins_it(whole):
    slam, answers = whole
    assert len(slam.maps) == 1 and answers[-1].state is TrackingState.TRACKING
    accepted = [loop for loop in slam.loops if loop.verdict == "accepted"]
    assert len(accepted) == 1 and accepted[0].frame * STEP > 560 and accepted[0].keyframe * STEP < 60
    assert answers[accepted[0].frame].reason == "a loop was closed"
    truth = corridor().truth()
    # In the first frame's world, along a corridor of 25 m there and back.
    found = errors(slam, truth, "none")
    assert found.position.rmse < 0.05 and found.rotation_deg.max < 1.0
    assert len(slam.trajectory()) > 135
    slam.finish()
    assert errors(slam, truth, "none").position.rmse < 0.05


@in_whole_run
def test_one_camera_is_in_maps_of_its_own_units():
    slam = Slam(corridor().sensor("mono"))
    frames = corridor().frames("mono")[:75]
    answers = [slam.track(frame) for frame in frames]
    first = next(n for n, a in enumerate(answers) if a.state is TrackingState.LOST)
    assert BLANK - 4 * STEP <= first * STEP <= BLANK + 3 * STEP
    away = [a for a in answers[first:] if a.state is TrackingState.SUBMAP]
    assert len(away) > 20 and all(a.world_from_body is None for a in away)
    assert all(a.world_from_body is None for a in answers[BLANK // STEP + 2 : TEXTURE // STEP + 1])
    assert len(slam.maps) >= 2
    for number in range(2):
        assert len(slam.trajectory(number)) > 15
        assert errors(slam, corridor().truth(), "similarity", number).position.rmse < 0.02


@in_whole_run
def test_a_map_that_is_never_joined_has_its_own_file(tmp_path):
    """The ride ends on the way: its parts are paths of their own, the longer one in the first file."""
    ride = corridor(200)
    numbers = range(40, 200, STEP)
    source, out = tmp_path / "ride", tmp_path / "out"
    (source / "rgb").mkdir(parents=True)
    (source / "depth").mkdir()
    rows = {"rgb": [], "depth": []}
    for frame in ride.frames("rgbd", numbers):
        name = f"{frame.timestamp_s:.6f}.png"
        cv2.imwrite(str(source / "rgb" / name), frame.gray)
        cv2.imwrite(str(source / "depth" / name), np.rint(5000 * frame.depth).astype(np.uint16))
        for kind, lines in rows.items():
            lines.append(f"{frame.timestamp_s:.6f} {kind}/{name}")
    for kind, lines in rows.items():
        (source / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    camera = ride.ride.camera
    params = ",".join(str(p + 0.5 * (n >= 2)) for n, p in enumerate(camera.params))
    result = run_slam(source, out, camera_params=params)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["submaps"] == result.summary["submaps"] and len(summary["submaps"]) == 1
    given = summary["submaps"][0]
    path = read_trajectory(out / "trajectory_submap_1.txt")
    assert len(path) == given["num_frames"] > 10 and given["num_keyframes"] >= 3
    assert (given["from_s"], given["to_s"]) == pytest.approx((path.timestamp_s[0], path.timestamp_s[-1]))
    assert not (out / "trajectory_submap_2.txt").exists()
    main = read_trajectory(out / "trajectory.txt")
    assert not set(main.timestamp_s) & set(path.timestamp_s)
    assert given["to_s"] < main.timestamp_s[0] and summary["num_localized"] == len(main) >= len(path)
    causal = read_trajectory(out / "trajectory_causal.txt")
    assert summary["num_localized_causal"] == len(causal) and not set(causal.timestamp_s) & set(
        path.timestamp_s
    )
    assert summary["states"]["submap"] >= len(main) and summary["states"]["lost"] > 0
    truth = ride.truth(numbers)
    rows = np.rint(10 * path.timestamp_s).astype(int)
    assert absolute_error(path.world_from_body, truth[rows], "rigid").position.rmse < 0.02
