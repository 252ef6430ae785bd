"""Pictures that are read out row by row: shifts undo the motion, the readout is found, and the path is straight with it."""

from dataclasses import replace

import numpy as np
import pytest
from slam_rides import drawn, errors

from epipole.cameras import Camera
from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import CameraOptions
from epipole.pipelines.slam.shutter import at_middle, refine_while_moving, shutter_shifts
from epipole.pipelines.slam.shutter_check import find_readout
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.slam_map import Keyframe, Observations, SlamMap

CAMERA, READOUT_S = Camera("PINHOLE", 640, 480, [450.0, 450.0, 319.5, 239.5]), 0.03
BY_THE_FRAMES = 0.09
"""Frames of the ride are 1/30 s apart, and told to be 1/10 s apart."""
MOTION = np.array([0.4, -0.2, 0.3, 0.2, 0.5, -0.3, 2.0, 1.0, -1.0, 3.0, -5.0, 2.0])


@pytest.fixture
def seen(rng):
    """Points, where rows that are read one after another see them, and the pose in the middle of the readout."""
    place = Rigid3.exp(np.array([0.1, 0.2, -0.1, 0.05, -0.1, 0.02]))
    in_cam = np.stack([rng.uniform(-2, 2, 300), rng.uniform(-1.5, 1.5, 300), rng.uniform(3, 8, 300)], axis=1)
    row = np.full(300, 239.5)
    for _ in range(20):  # the row tells when, and when tells the row
        late = READOUT_S * ((row + 0.5) / 480 - 0.5)
        moved = Rigid3.exp(late[:, None] * MOTION[:6] + 0.5 * late[:, None] ** 2 * MOTION[6:]).apply(in_cam)
        pixels = CAMERA.project(moved)
        row = pixels[:, 1]
    return place.inverse().apply(in_cam), pixels, place, moved


def test_shifts_undo_the_motion(seen):
    points, pixels, place, moved = seen
    model = SlamMap()
    rows = model.add_points(points, pixels, 0)
    keyframe = Keyframe(
        0, 0.0, np.zeros((480, 640), np.uint8), place, Observations(pixels, np.full(300, np.nan), rows)
    )
    keyframe.shift_px = shutter_shifts(model, keyframe, MOTION, CAMERA, READOUT_S)
    assert np.abs(keyframe.shift_px).max() > 3
    np.testing.assert_allclose(keyframe.straight_px, CAMERA.project(place.apply(points)), atol=1e-6)
    assert not shutter_shifts(model, keyframe, MOTION, CAMERA, 0.0).any()
    straight = at_middle(moved, pixels, MOTION, CAMERA, READOUT_S)
    np.testing.assert_allclose(straight, place.apply(points), atol=1e-9)


def test_pose_and_motion_are_found_together(seen, rng):
    points, pixels, place, _ = seen
    pixels = pixels + 0.1 * rng.normal(size=pixels.shape)
    pixels[:30] += 40.0  # mistakes
    start = Rigid3.exp(np.array([0.02, -0.02, 0.01, 0.01, 0.01, -0.01])) @ place
    found, motion, error_sq = refine_while_moving(points, pixels, CAMERA, start, np.zeros(12), READOUT_S)
    off = (found @ place.inverse()).log()
    assert np.linalg.norm(off[:3]) < 0.02 and np.degrees(np.linalg.norm(off[3:])) < 0.15
    np.testing.assert_allclose(motion[3:6], MOTION[3:6], atol=0.12)
    assert (error_sq[30:] < 1).mean() > 0.98 and (error_sq[:30] > 100).all()


@pytest.mark.usefixtures("unchecked_module")
def test_the_readout_is_found_and_the_path_straight_with_it():
    ride = drawn("shuttered", 75, 1)
    bent, straight = (Slam(replace(ride.sensor("rgbd"), readout_s=s)) for s in (0.0, BY_THE_FRAMES))
    for frame in ride.frames("rgbd"):
        bent.track(frame)
        straight.track(frame)
    found = find_readout(bent.mapper, bent.trajectory())
    assert found is not None and found.readout_s == pytest.approx(BY_THE_FRAMES, rel=0.1)
    assert "read one after another" in found.warning()
    before, after = (errors(one, ride.truth(), "none").position.rmse for one in (bent, straight))
    assert after < 0.5 * before
    with pytest.raises(ConfigError, match="readout_s"):
        CameraOptions(readout_s=-0.1)


@pytest.mark.usefixtures("unchecked_module")
def test_a_shutter_of_one_instant_has_none():
    ride = drawn("loop_room", 60, 2)
    slam = Slam(ride.sensor("rgbd"))
    for frame in ride.frames("rgbd"):
        slam.track(frame)
    assert find_readout(slam.mapper, slam.trajectory()) is None
