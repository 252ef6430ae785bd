"""A map that nothing holds stays where it was when it is adjusted."""

import numpy as np
import pytest
from slam_rides import rendered, tracked

from epipole.geometry import Rigid3, Similarity3
from epipole.pipelines.slam.map.gauge import align_gauge


@pytest.mark.parametrize("count", [2, 3, 30])
def test_a_similarity_is_undone(rng, count):
    before = Rigid3.exp(rng.normal(size=(count, 6)))
    moved = Similarity3.exp(np.array([0.3, -2.0, 1.0, 0.2, 0.5, -0.1, 0.4]))
    back = align_gauge(moved.move_cam_from_source(before), before)
    np.testing.assert_allclose((back @ moved).log(), 0.0, atol=1e-12)


def test_of_one_place_turns_alone_are_undone():
    rotations = Rigid3.exp(np.array([[0.0, 0, 0, 0, 0.1 * k, 0] for k in range(4)]))
    rotated = Similarity3.exp(np.array([0.0, 0, 0, 0.2, 0, 0, 0]))
    back = align_gauge(rotated.move_cam_from_source(rotations), rotations)
    np.testing.assert_allclose((back @ rotated).log(), 0.0, atol=1e-6)


def test_errors_are_shared_by_all(rng):
    before = Rigid3.exp(rng.normal(size=(12, 6)))
    after = Rigid3.exp(0.05 * rng.normal(size=(12, 6))) @ before
    moved = align_gauge(after, before).move_cam_from_source(after)

    def misfit(cams):
        return float(
            ((cams.centers() - before.centers()) ** 2).sum() + ((cams.rotation - before.rotation) ** 2).sum()
        )

    assert misfit(moved) < misfit(after)


@pytest.mark.usefixtures("unchecked_module")
def test_adjusting_one_camera_s_map_leaves_it_in_place():
    ride = rendered("loop_room", 60, 2)
    slam, _ = tracked(ride.frames("mono"), ride.sensor("mono"))
    before = slam.trajectory().world_from_body
    slam.odometry.mapper.adjust_all()
    after = slam.trajectory().world_from_body
    size = np.linalg.norm(np.ptp(before.translation, axis=0))
    assert np.abs(after.translation - before.translation).max() < 0.01 * size
    mean = np.linalg.norm((after.translation - before.translation).mean(axis=0))
    assert mean < 0.002 * size
