"""Images that are read out row by row: shifts undo the motion, the readout is found, and the path is straight with it."""

from dataclasses import replace

import numpy as np
import pytest
from slam_rides import Rendered, errors, rendered, tracked

from epipole.cameras import Camera
from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import CameraOptions
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations, SlamMap
from epipole.pipelines.slam.shutter.check import find_readout
from epipole.pipelines.slam.shutter.motion import shutter_shifts
from epipole.pipelines.slam.shutter.recent_motion import RecentMotion, motion_among
from epipole.pipelines.slam.shutter.shutter import Shutter
from epipole.pipelines.slam.slam import Slam
from whole import in_whole_run

CAMERA, READOUT_S = Camera("PINHOLE", 640, 480, [450.0, 450.0, 319.5, 239.5]), 0.03
SHUTTER = Shutter(CAMERA, READOUT_S)
BY_THE_FRAMES = 0.09
"""Frames of the ride are 1/30 s apart, and told to be 1/10 s apart."""
COUNT = 65
MOTION = np.array([0.4, -0.2, 0.3, 0.2, 0.5, -0.3, 2.0, 1.0, -1.0, 3.0, -5.0, 2.0])


@pytest.fixture
def seen(rng):
    """Points, where rows that are read one after another see them, and the pose in the middle of the readout."""
    position = Rigid3.exp(np.array([0.1, 0.2, -0.1, 0.05, -0.1, 0.02]))
    in_cam = np.stack([rng.uniform(-2, 2, 300), rng.uniform(-1.5, 1.5, 300), rng.uniform(3, 8, 300)], axis=1)
    row = np.full(300, 239.5)
    for _ in range(20):  # the row tells when, and when tells the row
        late = READOUT_S * ((row + 0.5) / 480 - 0.5)
        moved = Rigid3.exp(late[:, None] * MOTION[:6] + 0.5 * late[:, None] ** 2 * MOTION[6:]).apply(in_cam)
        pixels = CAMERA.project(moved)
        row = pixels[:, 1]
    return position.inverse().apply(in_cam), pixels, position, moved


def test_shifts_undo_the_motion(seen):
    points, pixels, position, moved = seen
    model = SlamMap()
    rows = model.add_points(points, pixels, 0)
    keyframe = Keyframe(
        0, 0.0, np.zeros((480, 640), np.uint8), position, Observations(pixels, 45.0 / moved[:, 2], rows)
    )
    keyframe.shift_px = shutter_shifts(model, keyframe, MOTION, SHUTTER)
    assert np.abs(keyframe.shift_px).max() > 3
    straight = position.apply(points)
    np.testing.assert_allclose(keyframe.straight_px, CAMERA.project(straight), atol=1e-6)
    np.testing.assert_allclose(keyframe.straight_disparity_px, 45.0 / straight[:, 2], rtol=1e-9)
    assert not shutter_shifts(model, keyframe, MOTION, Shutter(CAMERA, 0.0)).any()
    straight = SHUTTER.at_middle(moved, pixels, MOTION)
    np.testing.assert_allclose(straight, position.apply(points), atol=1e-9)


def test_pose_and_motion_are_found_together(seen, rng):
    points, pixels, position, _ = seen
    pixels = pixels + 0.1 * rng.normal(size=pixels.shape)
    pixels[:30] += 40.0  # mistakes
    start = Rigid3.exp(np.array([0.02, -0.02, 0.01, 0.01, 0.01, -0.01])) @ position
    found, motion, error_sq = SHUTTER.refine(points, pixels, start, np.zeros(12))
    off = (found @ position.inverse()).log()
    assert np.linalg.norm(off[:3]) < 0.02 and np.degrees(np.linalg.norm(off[3:])) < 0.15
    np.testing.assert_allclose(motion[3:6], MOTION[3:6], atol=0.12)
    assert (error_sq[30:] < 1).mean() > 0.98 and (error_sq[:30] > 100).all()


def bent_and_straight(ride: Rendered, kind: str, count: int) -> list[Slam]:
    """Of the first frames of a ride, without and with its readout."""
    sensors = (replace(ride.sensor(kind), readout_s=s) for s in (0.0, BY_THE_FRAMES))
    return [tracked(ride.frames(kind)[:count], sensor)[0] for sensor in sensors]


def shaken(seconds: float) -> Rigid3:
    """cam_from_world of a hand that shakes."""
    return Rigid3.exp(0.05 * np.sin(np.arange(6) + 12.0 * seconds)) @ Rigid3.exp(seconds * MOTION[:6])


def test_the_motion_is_told_by_the_frames_around():
    times = np.arange(5) / 30
    positions = [shaken(t) for t in times]
    cams = Rigid3(np.stack([p.rotation for p in positions]), np.stack([p.translation for p in positions]))
    late = 0.015
    for frame, least in ((2, 2e-4), (1, 1e-3), (4, 1e-2)):
        motion = motion_among(times, cams, frame)
        foretold = Rigid3.exp(late * motion[:6] + 0.5 * late**2 * motion[6:]) @ positions[frame]
        off = foretold @ shaken(times[frame] + late).inverse()
        assert np.abs(off.log()).max() < least
    recent = RecentMotion().start_at(0.0)
    for time, before, now in zip(times[1:], positions, positions[1:]):
        recent = recent.with_step(float(time), now @ before.inverse(), 1.0)
    np.testing.assert_allclose(recent.final_motions()[times[2]], motion_among(times, cams, 2), atol=1e-9)
    assert len(recent.final_motions()) == 5  # at first of all of them
    step = shaken(times[4] + 1 / 30) @ positions[4].inverse()
    assert list(recent.with_step(times[4] + 1 / 30, step, 1.0).final_motions()) == [times[3]]
    assert not recent.with_step(times[4] + 2.0, step, 1.0).times  # too long ago
    jump = Rigid3.exp(np.full(6, 1.0))  # of the map
    assert not recent.with_step(times[4] + 1 / 30, jump, 1.0).times
    assert recent.start_at(times[4]) is recent and recent.start_at(7.0).times == [7.0]


@in_whole_run
@pytest.mark.usefixtures("unchecked_module")
def test_one_camera_s_map_is_straight_from_its_begin():
    ride = rendered("shuttered", COUNT, 1)
    bent, straight = bent_and_straight(ride, "mono", 40)
    straight.finish()
    assert len(straight.trajectory()) == 40
    before, after = (errors(one, ride.truth(), "similarity").position.rmse for one in (bent, straight))
    assert after < 0.1 * before


@pytest.mark.usefixtures("unchecked_module")
def test_the_readout_is_found_and_the_path_straight_with_it():
    ride = rendered("shuttered", COUNT, 1)
    bent, straight = bent_and_straight(ride, "rgbd", COUNT)
    found = find_readout(bent.odometry.mapper, bent.trajectory())
    assert found is not None and found.readout_s == pytest.approx(BY_THE_FRAMES, rel=0.1)
    assert "rolling shutter with a readout of" in found.warning()
    before, after = (errors(one, ride.truth(), "none").position.rmse for one in (bent, straight))
    assert after < 0.1 * before
    with pytest.raises(ConfigError, match="readout_s"):
        CameraOptions(readout_s=-0.1)


@pytest.mark.usefixtures("unchecked_module")
def test_a_shutter_of_one_instant_has_none():
    ride = rendered("loop_room", 60, 2)
    slam, _ = tracked(ride.frames("rgbd"), ride.sensor("rgbd"))
    assert find_readout(slam.odometry.mapper, slam.trajectory()) is None
