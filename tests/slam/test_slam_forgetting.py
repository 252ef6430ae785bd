"""A place that is seen again and again costs no more keyframes, and nothing that is told gets lost."""

from dataclasses import replace

import numpy as np
import pytest
from slam_rides import RGBD, ride, tracked

from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.map import culling as forgetting
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations, SlamMap
from epipole.pipelines.slam.map.trajectory import Path
from epipole.pipelines.slam.slam import Slam
from whole import in_whole_run

OFTEN = SlamConfig(keyframe_gap=2)
"""A keyframe every second frame."""


@pytest.fixture
def few_in_sight(monkeypatch):
    monkeypatch.setattr(forgetting, "MOST_IN_SIGHT", 6)
    monkeypatch.setattr(forgetting, "LATEST", 3)


def to_and_fro(laps):
    """The ride, back, and again: every frame at its own time."""
    frames = ride().frames("rgbd")[:14]
    trajectory = [*range(14), *range(12, 0, -1)] * laps
    return [replace(frames[n], timestamp_s=0.1 * k) for k, n in enumerate(trajectory)], trajectory


def test_keyframes_stay_few_and_the_path_stays(few_in_sight):
    frames, trajectory = to_and_fro(3)
    slam, counts = Slam(RGBD, OFTEN), []
    for frame in frames:
        slam.track(frame)
        counts.append(len(slam.map.keyframes))
    third = len(frames) // 3
    assert counts[-1] <= counts[third] + 2 and counts[-1] < 20
    # What the first visit mapped stays: the map is not made anew with every visit, and does not wander.
    assert sum(k.number < third for k in slam.map.keyframes) >= counts[third] - 3
    path, truth = slam.trajectory(), ride().truth()
    assert len(path) == len(frames)
    off = path.world_from_body.translation - truth.translation[trajectory]
    assert np.linalg.norm(off, axis=1).max() < 0.03
    slam.finish()
    assert len(slam.trajectory()) == len(frames)


@in_whole_run
def test_without_forgetting_they_grow():
    frames, _ = to_and_fro(3)
    slam, _ = tracked(frames, RGBD, OFTEN)
    assert len(slam.map.keyframes) > 25


def made_map():
    """Three keyframes; points 0 to 3 are seen by all, 4 by the first alone, 5 by the last two."""
    model = SlamMap()
    model.add_points(
        np.arange(18.0).reshape(6, 3) + 5.0, np.arange(12.0).reshape(6, 2), np.array([0, 0, 0, 0, 0, 1])
    )
    for k, points in enumerate(([0, 1, 2, 3, 4], [0, 1, 2, 3, 5], [0, 1, 2, 3, 5])):
        rows = np.array(points)
        seen = Observations(10.0 * k + rows[:, None] + np.zeros((5, 2)), np.full(5, np.nan), rows)
        position = Rigid3.exp(np.array([0.1 * k, 0.0, 0.0, 0.0, 0.05 * k, 0.0]))
        model.keyframes.append(Keyframe(k, float(k), np.zeros((4, 4), np.uint8), position, seen))
    return model


def test_points_outlive_the_keyframe_that_saw_them_first():
    model = made_map()
    model.remove_keyframe(0)
    assert (
        len(model.keyframes) == 2
        and np.isnan(model.xyz[4]).all()
        and np.isfinite(model.xyz[[0, 1, 2, 3, 5]]).all()
    )
    for point in range(4):  # each is known by a keyframe that sees it, where it sees it
        keyframe = model.keyframes[model.anchor[point]]
        row = int(np.flatnonzero(keyframe.point == point)[0])
        np.testing.assert_array_equal(model.anchor_px[point], keyframe.pixels[row])


def test_rows_of_points_are_put_together():
    model = made_map()
    model.remove_keyframe(0)
    before = model.xyz.copy()
    into = model.keep_points(np.arange(6) != 4)
    assert into.tolist() == [0, 1, 2, 3, -1, 4] and model.num_points == 5
    np.testing.assert_array_equal(model.xyz, before[[0, 1, 2, 3, 5]])
    assert all((k.point == [0, 1, 2, 3, 4]).all() for k in model.keyframes)
    rows = model.add_points(np.ones((3, 3)), np.zeros((3, 2)), 0)
    assert rows.tolist() == [5, 6, 7]


def test_frames_are_told_from_another_keyframe():
    model, path = made_map(), Path()
    gone, heir = model.keyframes[1], model.keyframes[2]
    position = Rigid3.exp(np.array([0.3, 0.1, 0.0, 0.1, 0.0, 0.2]))
    path.add(7, 0.7, gone, position, np.eye(6))
    path.retell(gone, heir)
    given = path.trajectory([heir]).world_from_body[0]
    np.testing.assert_allclose((given @ position).translation, 0.0, atol=1e-12)
    heir.cam_from_world = heir.cam_from_world @ Rigid3.exp(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    moved = path.trajectory([heir]).world_from_body[0]  # and goes with it
    assert np.linalg.norm(moved.translation - given.translation) == pytest.approx(1.0)
    assert not len(path.trajectory([gone]))
