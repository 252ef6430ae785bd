"""Frames whose map was not settled when they came are placed again by what they saw, with their own keyframes."""

import numpy as np
import pytest
from slam_rides import CAMERA, MONO, RGBD

from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.map.past_poses import KEYFRAMES_LATER, refine_past_poses
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations, SlamMap
from epipole.pipelines.slam.map.trajectory import Path
from epipole.pipelines.slam.tracking.points import SeenFrame
from epipole.pipelines.slam.tracking.tracker import PointTracker

NUM_FRAMES = 3 * KEYFRAMES_LATER + 3
FOCAL_BASELINE, OFF = 31.2, Rigid3.exp(np.array([0.03, -0.02, 0.04, 0.01, 0.02, -0.01]))


def position(number: int) -> Rigid3:
    """cam_from_world of a frame."""
    return Rigid3.exp(np.array([-0.05 * number, 0.0, 0.0, 0.0, 0.01 * number, 0.0]))


@pytest.fixture
def scene(rng):
    """A map with keyframes 0, 3, 6, ...; frames between are told from them with an error."""
    points = np.stack([rng.uniform(-2, 2, 120), rng.uniform(-1, 1, 120), rng.uniform(3, 6, 120)], axis=1)
    model, path = SlamMap(), Path()
    rows = model.add_points(points, np.zeros((120, 2)), 0)
    for number in range(0, NUM_FRAMES, 3):
        seen = Observations(np.zeros((120, 2)), np.full(120, np.nan), rows)
        keyframe = Keyframe(number, number / 10, np.zeros((240, 320), np.uint8), position(number), seen)
        model.keyframes.append(keyframe)
        path.add(number, number / 10, keyframe, position(number), np.zeros((6, 6)))
        for later in (1, 2):
            given = OFF @ position(number + later)
            path.add(number + later, (number + later) / 10, keyframe, given, np.eye(6))
    return model, path


def waiting(model: SlamMap, number: int, *, has_depth: bool) -> SeenFrame:
    there = position(number).apply(model.xyz)
    deep = FOCAL_BASELINE / there[:, 2] if has_depth else None
    seen = SeenFrame(number / 10, CAMERA.project(there), np.arange(model.num_points), deep)
    seen.number = number
    return seen


def errors(path: Path, model: SlamMap) -> np.ndarray:
    """(n,) by frame."""
    found = path.trajectory(model.keyframes).world_from_body.inverse()
    return np.array(
        [np.abs((found[n] @ position(n).inverse()).log()).max() for n in range(len(found.rotation))]
    )


@pytest.mark.parametrize("has_depth", [False, True])
def test_frames_that_waited_long_enough_are_placed_in_the_map_as_it_is(scene, has_depth):
    model, path = scene
    camera, focal_baseline = (RGBD, FOCAL_BASELINE) if has_depth else (MONO, None)
    tracker = PointTracker(model, camera, focal_baseline, SlamConfig())
    numbers = [n for n in range(NUM_FRAMES) if n % 3]
    tracker.waiting = [waiting(model, number, has_depth=has_depth) for number in numbers]
    model.keyframes[1].cam_from_world = OFF @ model.keyframes[1].cam_from_world  # adjusted since
    tracker.waiting.append(waiting(model, 3, has_depth=has_depth))
    refine_past_poses(path, tracker)
    # For these few keyframes have come since.
    assert [one.number for one in tracker.waiting] == [*numbers[2:], 3]
    found = errors(path, model)
    assert found[1:3].max() < 1e-6 and found[4:6].min() > 0.01
    refine_past_poses(path, tracker, is_last=True)
    found = errors(path, model)
    assert tracker.waiting == [] and found[3] > 0.01  # a keyframe is where the adjustment puts it
    assert np.delete(found, 3).max() < 1e-6
    covariances = path.trajectory(model.keyframes).covariance
    if has_depth:  # told again, by errors of which there are none
        assert np.linalg.eigvalsh(covariances[2]).min() > 0 and covariances[2].max() < 1e-6
    else:
        np.testing.assert_allclose(covariances[2], np.eye(6))  # as it was told


def test_few_points_and_frames_without_a_place_stay(scene):
    model, path = scene
    tracker = PointTracker(model, MONO, None, SlamConfig())
    few, nowhere = waiting(model, 1, has_depth=False), waiting(model, 900, has_depth=False)
    few.point, few.pixels = few.point[:5], few.pixels[:5]
    tracker.waiting = [few, nowhere]
    before = errors(path, model)
    refine_past_poses(path, tracker, is_last=True)
    np.testing.assert_array_equal(errors(path, model), before)
    refine_past_poses(path, tracker)  # none waits
