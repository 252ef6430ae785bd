"""Two maps of one room become one, in the first one's world and unit; maps of different rooms stay apart."""

import numpy as np
import pytest
from slam_rides import rendered

from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.metrics import absolute_error
from epipole.pipelines.slam.loops.merging import merge_maps
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.slam import Slam
from whole import IS_WHOLE

pytestmark = pytest.mark.usefixtures("unchecked_module")

FIRST, SECOND = range(0, 100, 4), range(64, 168, 4)


def map_of(ride, kind, numbers):
    """The map of a run through these frames, and the number in the ride of each frame."""
    system = Slam(ride.sensor(kind))
    for frame in ride.frames(kind, numbers):
        system.track(frame)
    system.finish()
    return system.maps[0]


@pytest.fixture(scope="module")
def ride():
    return rendered("loop_room", 168, 4)


@pytest.mark.parametrize("kind", ["mono"] + IS_WHOLE * ["rgbd"])
def test_two_runs_that_share_a_part_of_the_room_become_one_map(ride, kind):
    first, second = map_of(ride, kind, FIRST), map_of(ride, kind, SECOND)
    points, poses = first.xyz.copy(), [k.cam_from_world.log() for k in second.keyframes]
    merged = merge_maps(first, second, ride.sensor(kind))
    assert merged.success and not merged.reason
    model = merged.model
    assert len(model.keyframes) == len(first.keyframes) + len(second.keyframes)
    numbers = [list(FIRST)[k.number] for k in first.keyframes] + [
        list(SECOND)[k.number] for k in second.keyframes
    ]
    assert [k.number for k in model.keyframes[len(first.keyframes) :]] == [
        k.number + merged.number_offset for k in second.keyframes
    ]
    truth = ride.truth(list(range(0, 168, 4)))[np.array(numbers) // 4]
    found = [k.cam_from_world.inverse() for k in model.keyframes]
    estimate = Rigid3(np.stack([p.rotation for p in found]), np.stack([p.translation for p in found]))
    error = absolute_error(estimate, truth, "similarity" if kind == "mono" else "rigid")
    assert error.position.rmse < 0.02
    # Points of both are the same points, and nothing that was given has changed.
    shared = np.intersect1d(
        model.keyframes[len(first.keyframes) - 1].point, model.keyframes[len(first.keyframes)].point
    )
    assert len(shared) > 20
    np.testing.assert_array_equal(first.xyz, points)
    np.testing.assert_array_equal([k.cam_from_world.log() for k in second.keyframes], poses)
    assert float(merged.first_from_second.scale) == 1.0 or kind == "mono"


def test_maps_of_different_rooms_are_not_merged(ride):
    first = map_of(ride, "rgbd", FIRST)
    corridor = rendered("corridor", 60, 4)
    second = map_of(corridor, "rgbd", range(0, 60, 4))
    merged = merge_maps(first, second, ride.sensor("rgbd"))
    assert not merged.success and "recognized" in merged.reason
    assert len(merged.model.keyframes) == len(first.keyframes)


def test_a_copied_map_shares_nothing_that_moving_it_changes():
    model = SlamMap()
    model.recent.steps = [Rigid3(np.eye(3), np.array([1.0, 0.0, 0.0]))]
    copied = model.copied()
    copied.rescale(3.0)
    assert [step.translation[0] for step in model.recent.steps] == [1.0]


def test_an_empty_map_is_refused(ride):
    with pytest.raises(ConfigError, match="keyframes with points"):
        merge_maps(SlamMap(), SlamMap(), ride.sensor("rgbd"))
